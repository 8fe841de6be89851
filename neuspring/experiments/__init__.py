"""Many runs: what a configuration asks for and costs, the jobs that make it, the MLflow index, tuning studies."""
