"""The command line: `main` runs one command, `options` holds the options that commands share."""
