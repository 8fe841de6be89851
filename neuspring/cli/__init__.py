"""The command line: `main` runs one command.

A stage's command is in its own module (`neuspring.stages`). `main.TOOLS` names the modules of the others: `data`, `results`,
`pictures`, `twins`.
"""
