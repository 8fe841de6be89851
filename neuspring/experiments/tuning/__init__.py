"""Sweeps: Optuna studies over settings of one method.

`space`: what a sweep varies. `trial`: search and fit with a trial's settings. `worker`: one worker, a job of the workflow (`work`),
and the storage that workers share. `report`: summary, tables, pictures, run records and best overlay (`report`).
"""
