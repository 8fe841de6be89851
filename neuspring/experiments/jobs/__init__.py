"""The wrapper of every job of the workflow: its GPU lease, log, measured use, record, and the cause if it fails."""
