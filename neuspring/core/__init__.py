"""The ground that everything stands on.

- `artifacts`: the nouns (`Observations`, `Topology`, `Material`, `Twin`, `Trajectory`, ...); `geometry`: points and lines.
- `records`, `run_record`, `job_records`: what a stage, a run, a job did; `Recorder` measures a stage and writes its record.
- `errors`: `InputError` and `NumericalFailure`; `findings`: what is implausible, but no reason to stop.
- `files`: written whole, or not there; `lock`; `text`: tables, addresses and progress as they are printed.
- `provenance`: digests of code, and the commit; `checkpoint`: stages and trainings that continue after a kill.
- `device`: Warp's start, which device a setting means, kernels compiled once; `weights`: files of trained weights.

Importing this package loads neither torch nor Warp; `device` does, and `checkpoint` and `weights` when they are used.
"""
