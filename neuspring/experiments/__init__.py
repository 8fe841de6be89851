"""The workflow behind the Snakefile: from a configuration to its jobs.

- `benchmark`: the configuration with its table rows, checked; `graph`: the jobs and their digests; `tasks`: jobs over many runs.
- `plan`: the plan before the first job; `messages`: messages during and after a run; `claim`: one run per results folder.
- `job`: the wrapper of every job; `gpus`: GPU leases; `local`: the workflow's command on this machine.
- `tracking`: MLflow, an index of the run records.
"""
