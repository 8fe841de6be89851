"""What everything stands on.

- `artifacts`: the nouns (`Observations`, `Topology`, `Material`, `Twin`, `Trajectory`, ...); `npz`: how they become files.
- `records`, `run_record`, `job_records`: what a stage, a run, a job did; `Recorder` measures a stage and writes its record.
- `errors`: `InputError` and `NumericalFailure`; `files`, `lock`, `uri`, `markdown`, `points`: small tools.
- `provenance`: digests of code, and the commit; `checkpoint`, `training`: stages that continue after a kill.
- `device`: Warp's start, which device a setting means, kernels compiled once; `weights`: files of trained weights.
- `progress`: the line of long work.

Importing this package loads neither torch nor Warp; `device` does, and `training` and `weights` when they are used.
"""
