"""Many runs: from a configuration to the jobs that make it.

- `benchmark`: the configuration with the rows of its tables, checked; `graph`: what the rules ask about a job, and
  about jobs that look at many runs; `needs`: GPUs, memory and time of jobs.
- `messages`: what a user is told while the workflow runs and afterwards.
- `jobs`: the wrapper of every job, GPU leases, causes of failure, the warm process.
- `tracking`: MLflow, an index of the run records.
"""
