"""One module per format, with its variable `export`."""
