"""MLflow as an index of the run records. Only this package imports it."""
