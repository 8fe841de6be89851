"""The command line: `main` runs one command, `tools` names the modules of those that are no stage of the workflow."""
