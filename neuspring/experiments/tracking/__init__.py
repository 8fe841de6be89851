"""MLflow as an index of the run records. No other package imports mlflow.

`log`: create the index (`init`), log a run (`log_run`), log all runs that are missing (`sync`).
`store`: where the index is, how it is created, and what it holds.
"""
