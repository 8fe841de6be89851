"""Tuning studies with Optuna: what may vary, the workers' shared store, a trial, the report."""
