"""The command line: `main` runs one command.

The modules of `neuspring.stages` contain the commands of stages. `data`, `results` and `workflow` contain the other commands of the
core, and the module `commands` of an extension its commands. `main.COMMANDS` is the registry of all commands except stages.
"""
