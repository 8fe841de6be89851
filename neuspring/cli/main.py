"""The command line, `neuspring`: every stage of the workflow as a command, and other tools.

A command is a typed function, either a stage or a member of `COMMANDS`; tyro derives its options.

Exit status: 0 finished (a numerical failure is a recorded result), 2 invalid input (the same input fails again), 130 interrupted,
1 other errors. `main` sets the number of threads before it imports the module of the command.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from neuspring.core.errors import InputError, NumericalFailure, full_disk
from neuspring.core.version import __version__
from neuspring.registry import Registry

_OURS = {
    "data": "check-data mask compare-masks",
    "results": "tables perception-table study explain report sync ui",
    "workflow": "demo",
}
COMMANDS: Registry[Callable[..., int | None]] = Registry(
    "commands",
    {name: f"neuspring.cli.{module}:{name.replace('-', '_')}" for module, names in _OURS.items() for name in names.split()},
)
"""Commands that are not stages. A dot in a name is a space in the command: `draw.film` is `neuspring draw film`."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OWN_THREADS = ("search",)
"""Commands that start --threads threads themselves, so numerical libraries use one thread in each."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, _threads(words))
    try:
        return _run(words)
    except (InputError, NumericalFailure) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print("neuspring: interrupted. Rerun the same command; searches and fits resume from their checkpoints.", file=sys.stderr)
        return 128 + signal.SIGINT
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        print(f"neuspring: error: {full_disk(Path(error.filename or '.'))}", file=sys.stderr)
        return 1


def _threads(words: Sequence[str]) -> str:
    """Number of threads of numerical libraries, from --threads. Libraries read it at import, before tyro parses the options."""
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
    tools = {name.replace(".", " "): name for name in COMMANDS}
    command = next((name for name in (" ".join(words[:2]), words[0]) if name in tools), words[0])
    if command in tools:
        import tyro

        function = COMMANDS[tools[command]]
        rest, options = words[len(command.split()) :], (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
        return tyro.cli(function, args=rest, prog=f"neuspring {command}", description=function.__doc__, config=options) or 0
    from neuspring.stages import STAGES

    if command in STAGES:
        STAGES[command](**STAGES[command].parse(words[1:]))
        return 0
    close = [name for name in tools if name.startswith(f"{words[0]} ")] or difflib.get_close_matches(
        command, [*STAGES, *tools], n=1
    )
    remedy = f"Did you mean {' or '.join(close)}?" if close else "neuspring --help lists all commands."
    raise InputError("command", "must be one of the commands", command, remedy)


def _about(registry: Registry[Any], name: str) -> str:
    """First sentence of a command's docstring, read from the source if possible, because importing all commands takes seconds."""
    file = Path(__file__).parents[2] / f"{registry.module_of(name).replace('.', '/')}.py"
    start = f"def {name.replace('-', '_').replace('.', '_')}("
    text = file.read_text(encoding="utf-8").partition(start)[2].split('"""')[1] if file.exists() else registry[name].__doc__
    return re.split(r"[.:;] |\.?\n|\.$", text or "")[0]


def _overview() -> str:
    from neuspring.stages import STAGES

    stages, tools = (
        [f"  {name.replace('.', ' '):<17} {_about(registry, name)}" for name in registry] for registry in (STAGES, COMMANDS)
    )
    usage = "usage: neuspring COMMAND [options]; neuspring COMMAND --help\n"
    about = "NeuSpring makes spring-mass twins of deformable objects from RGBD videos.\n\nStages of the workflow:"
    return "\n".join([usage, about, *stages, "\nOther commands:", *tools])
