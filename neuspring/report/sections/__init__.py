"""Sections of the report page: curves, pictures, hours and failures, settings; `data` is what all of them read."""
