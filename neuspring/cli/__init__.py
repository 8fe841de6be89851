"""The command line: `main` runs one command.

A stage's command is in its own module (`neuspring.stages`). `tools.TOOLS` names the modules of the others: `data`, `results`,
`tracking`, `sweeps`, `doctor`.
"""
