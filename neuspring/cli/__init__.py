"""The command line: `main` runs one command.

A stage's command is in its own module (`neuspring.stages`). `data` and `results` hold the core's tools, a module `commands` of an
extension its own; `main.COMMANDS` is the registry of all.
"""
