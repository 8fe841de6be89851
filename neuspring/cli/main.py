"""The command line, `neuspring`: every stage of the workflow by hand, and the tools around it.

A command is a typed function: a stage, or a function of `TOOLS`; tyro makes its options. Exit status: 0 done (a numerical failure
is a recorded result), 2 bad input (only another input can help), 1 anything else. Only the module of the command that runs is
imported, after the number of threads is set.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import importlib
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.version import __version__

TOOLS = {
    "draw strip": ("pictures", "observed frames on top, each method's prediction and error below -> PDF or PNG"),
    "draw twin": ("pictures", "stiffness and regions of twins, from any side -> PDF or PNG"),
    "draw film": ("pictures", "observed beside predicted, moving -> MP4 or GIF of limited size"),
    "draw frames": ("pictures", "splats and trajectory -> RGBA pictures of any camera"),
    "play": ("twins", "runs of a results folder in the browser; twins that can be pulled by hand"),
    "export": ("twins", "a twin -> USD, PLY, Newton, MuJoCo, or npz with a JSON description"),
    "fetch": ("data", "released archives -> the folders that the readers expect"),
    "make-capture": ("data", "color and depth of a camera, or points in space -> a capture folder"),
    "cut-capture": ("data", "some frames of a capture, with their masks -> another capture"),
    "check-data": ("data", "report how a data folder departs from the expected layout"),
    "mask": ("data", "marks on a few frames -> masks of object and hands in every frame of a capture"),
    "compare-masks": ("data", "two folders of masks -> their overlap per frame"),
    "annotate": ("data", "mark masks and tracks of a capture in the browser"),
    "verify-released": ("data", "PhysTwin's released results, checked against ours"),
    "tables": ("results", "run records -> tables"),
    "perception-table": ("results", "errors of perception, per category"),
    "study": ("results", "run records -> one of the paper's tables, beside the paper's values"),
    "explain": ("results", "a cell of a study's table -> the runs behind it, and how to make them again"),
    "report": ("results", "results folder -> one self-contained HTML file"),
    "track-init": ("results", "prepare the MLflow store, once before any run is logged"),
    "log": ("results", "log one run.json to MLflow"),
    "sync": ("results", "send to MLflow what is missing there, and close runs that were killed"),
    "ui": ("results", "open the MLflow UI of a results folder"),
    "tune": ("results", "one worker of a sweep"),
    "tune-report": ("results", "a sweep -> summary, plots, best.yaml"),
    "doctor": ("results", "say what this machine can do, and what is missing"),
}
"""Command -> the module of neuspring.cli with a function of its name, and what it does."""
LEFT = {
    "compare": "Removed: name two runs on MLflow's page (`neuspring ui`) and press Compare; commit a72d24c is the last that has it."
}
"""Commands of older versions -> what to do now."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OWN_THREADS = ("search",)
"""Commands that share their work among --threads threads of their own: numerical libraries have one in each of them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    for name in THREADS:
        os.environ.setdefault(name, _threads(words))
    try:
        return _run(words)
    except (InputError, NumericalFailure) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print("neuspring: stopped. Start it again; searches and fits go on from their checkpoints.", file=sys.stderr)
        return 128 + signal.SIGINT
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        print(f"neuspring: error: {full_disk(Path(error.filename or '.'))}", file=sys.stderr)
        return 1


def full_disk(path: Path) -> InputError:
    """What is said where a file does not fit on its disk."""
    disk = next(folder for folder in [path.absolute(), *path.absolute().parents] if folder.is_mount())
    free, whole = (size / 1e9 for size in (shutil.disk_usage(disk).free, shutil.disk_usage(disk).total))
    rule = f"no space left on device: the disk at {disk} has {free:.1f} of {whole:.1f} GB free"
    return InputError(path, rule, None, "Free some space there; the same command continues, and what is finished is kept.")


def _threads(words: Sequence[str]) -> str:
    """Threads of numerical libraries: those of --threads, before any parser knows it, as they read it when they are imported."""
    if words[:1] and words[0] in OWN_THREADS:
        return "1"
    known = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    known.add_argument("--threads", default="1")
    try:
        return str(known.parse_known_args(list(words))[0].threads)
    except argparse.ArgumentError:
        return "1"


def _run(words: list[str]) -> int:
    if words[:1] == ["--version"]:
        print(__version__)
        return 0
    if words[:1] in ([], ["-h"], ["--help"]):
        print(_overview())
        return 0 if words else 2
    command = " ".join(words[:2]) if words[0] == "draw" else words[0]
    if command in TOOLS:
        import tyro

        module = importlib.import_module(f"neuspring.cli.{TOOLS[command][0]}")
        function = getattr(module, command.replace("-", "_").replace(" ", "_"))
        rest, options = words[len(command.split()) :], (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
        about = (function.__doc__ or "").strip()
        return tyro.cli(function, args=rest, prog=f"neuspring {command}", description=about, config=options) or 0
    from neuspring.stages import STAGES

    if command in STAGES:
        STAGES[command](**STAGES[command].parse(words[1:]))
        return 0
    close = [name for name in TOOLS if name.startswith(f"{words[0]} ")]
    close = close or difflib.get_close_matches(command, [*STAGES, *TOOLS], n=1)
    remedy = LEFT.get(command) or (f"Did you mean {' or '.join(close)}?" if close else "neuspring --help names all.")
    raise InputError("command", "must be a stage or a tool", command, remedy)


def _overview() -> str:
    from neuspring.stages import STAGES

    stages = [f"  {name:<17} {stage.about}" for name, stage in STAGES.items()]
    tools = [f"  {name:<17} {about}" for name, (_, about) in TOOLS.items()]
    head = (
        "usage: neuspring COMMAND [options]; neuspring COMMAND --help\n\nSpring-mass twins of deformable objects from RGBD video."
    )
    return "\n".join([head, "\nStages of the workflow, each by hand:", *stages, "\nTools:", *tools])
