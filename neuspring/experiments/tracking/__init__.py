"""MLflow as an index of the run records. No other package imports mlflow.

`log`: create the index (`init`), log a run (`log_run`), log all missing runs (`sync`).
`store`: the location of the index, its creation, and its view of runs.
"""
