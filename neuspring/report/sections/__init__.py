"""Sections of the report page, one module each; a `SECTION` says what makes it and where it stands."""
