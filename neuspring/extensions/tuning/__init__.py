"""Sweeps: Optuna studies over settings of one method."""
