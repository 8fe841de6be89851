"""The version; pyproject.toml reads it, and so does whatever writes it into a file."""

__version__ = "0.6.0"
