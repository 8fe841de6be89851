"""The wrapper of every job of the workflow. All other modules serve it.

`wrapper`: one job, from its GPU lease to its record; it runs the command, follows its output, samples its use of the machine.
`gpus`: leases of GPUs. `faults`: why a command failed, and whether trying again can help. `warm`: a process that jobs start from.
"""
