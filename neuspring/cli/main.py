"""The command line, `neuspring`: every stage of the workflow by hand, and the tools around it.

Exit status: 0 done (a numerical failure is a recorded result), 2 bad input (only another input can help), 1 anything else.
Only the module of the command that runs is imported, after the number of threads is set.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence

from neuspring import __version__
from neuspring.cli.tools import TOOLS
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.stages import STAGES

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OWN_THREADS = ("search",)
"""Commands that share their work among --threads threads of their own: numerical libraries have one in each of them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["draw"]:
        words = importlib.import_module("neuspring.cli.draw").words(words)
    for name in THREADS:
        os.environ.setdefault(name, _threads(words))
    try:
        if words and words[0] in STAGES:
            STAGES[words[0]](**STAGES[words[0]].parse(words[1:]))
            return 0
        parsed = _parser(words[0] if words else "").parse_args(words)
        return parsed.command(parsed) or 0
    except (InputError, NumericalFailure) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1


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


def _parser(name: str) -> argparse.ArgumentParser:
    """The parser, with the options of the command `name` alone: the modules of the others stay unimported."""
    parser = argparse.ArgumentParser(prog="neuspring", description="Spring-mass twins of deformable objects from RGBD video.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="command")
    about = {stage: declared.about for stage, declared in STAGES.items()} | {tool: text for tool, (_, text) in TOOLS.items()}
    for command, text in about.items():
        own = commands.add_parser(command, help=text, description=text)
        if command == name:
            add_options, run = _functions(command)
            add_options(own)
            own.set_defaults(command=run)
    return parser


def _functions(command: str) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int | None]]:
    """What adds a command's options, and what runs it."""
    module, name = importlib.import_module(TOOLS[command][0]), command.replace("-", "_")
    return getattr(module, f"{name}_options"), getattr(module, name)
