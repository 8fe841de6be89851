"""Sweeps: Optuna studies over settings of one method.

`space`: what a sweep varies. `worker`: one worker, a job of the workflow (`work`). `trial`: search and fit with a trial's settings.
`store`: the storage that workers share, and who works on which trial. `records`: run records of trials and sweep. `report`:
summary, tables and best overlay (`report`). `figures`: its pictures.
"""
