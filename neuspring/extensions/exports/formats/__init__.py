"""One file a format, named after it: its `export`."""
