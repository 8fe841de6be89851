"""Sections of the report page, one module each. `section` in a module declares the title, the position and the function."""
