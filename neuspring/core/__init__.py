"""Foundation modules that all other packages use.

- `artifacts`: the data types (`Observations`, `Topology`, `Material`, `Twin`, `Trajectory`, ...); `geometry`: points and lines.
- `records`, `run_record`, `job_records`: records of a stage, a run and a job; `Recorder` measures a stage and writes its record.
- `errors`: `InputError` and `NumericalFailure`; `checks`, `findings`: implausible data that do not stop a run.
- `files`: atomic writes; `lock`: locks that commands inherit; `text`, `table`: printed text and tables.
- `provenance`: digests of code, and the commit; `checkpoint`: resuming killed stages and trainings.
- `device`: starts Warp, resolves the device setting, compiles kernels once; `weights`: files of trained weights.

Importing this package loads neither torch nor Warp; `device` loads both, `checkpoint` and `weights` load torch on use.
"""
