"""The commands around the workflow: `TOOLS` names the module that has them, as functions `NAME` and `NAME_options`."""

TOOLS = {
    "draw": ("neuspring.stages.draw", "splats and trajectory -> RGBA pictures of any camera"),
    "fetch": ("neuspring.cli.data", "released archives -> the folders that the readers expect"),
    "check-data": ("neuspring.cli.data", "report how a data folder departs from the expected layout"),
    "mask": ("neuspring.cli.masks", "marks on a few frames -> masks of object and hands in every frame of a capture"),
    "compare-masks": ("neuspring.cli.masks", "two folders of masks -> their overlap per frame"),
    "annotate": ("neuspring.cli.annotate", "mark masks and tracks of a capture in the browser"),
    "verify-released": ("neuspring.cli.data", "PhysTwin's released results, checked against ours"),
    "tables": ("neuspring.cli.results", "run records -> tables"),
    "perception-table": ("neuspring.cli.results", "errors of perception, per category"),
    "study": ("neuspring.cli.results", "run records -> one of the paper's tables, beside the paper's values"),
    "explain": ("neuspring.cli.results", "a cell of a study's table -> the runs behind it, and how to make them again"),
    "report": ("neuspring.cli.results", "results folder -> one self-contained HTML file"),
    "track-init": ("neuspring.cli.tracking", "prepare the MLflow store, once before any run is logged"),
    "log": ("neuspring.cli.tracking", "log one run.json to MLflow"),
    "sync": ("neuspring.cli.tracking", "send to MLflow what is missing there, and close runs that were killed"),
    "compare": ("neuspring.cli.tracking", "runs of two commits, from MLflow -> paired differences"),
    "ui": ("neuspring.cli.tracking", "open the MLflow UI of a results folder"),
    "tune": ("neuspring.cli.sweeps", "one worker of a sweep"),
    "tune-report": ("neuspring.cli.sweeps", "a sweep -> summary, plots, best.yaml"),
    "doctor": ("neuspring.cli.doctor", "say what this machine can do, and what is missing"),
}
