"""The command export: a twin in the formats of other tools."""

from __future__ import annotations

import importlib
from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.core.errors import InputError

FORMATS = {
    "npz": ("plain.write", "", "{name}_npz"),
    "ply": ("ply.write", "0", "{name}"),
    "spz": ("spz.write", "0", "{name}"),
    "newton": ("simulators.write_newton", "", "{name}_newton"),
    "mujoco": ("simulators.write_mujoco", "", "{name}_mujoco"),
    "usd": ("usd.write", "", "{name}.usdc"),
}
"""Format -> module and function of neuspring.export, frames by default (all where empty), what is written by default."""


def export_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring export`."""
    parser.add_argument("twin", type=Path, metavar="TWIN", help="a run's folder, results/<scenario>/<method>/<seed>, or a twin.npz")
    parser.add_argument("--to", required=True, choices=tuple(FORMATS), help="format")
    parser.add_argument("--output", type=Path, help="file or folder to write; by default it is named after the run")
    parser.add_argument("--frames", help="FIRST, FIRST:STOP or FIRST:STOP:STEP; all by default, of ply and spz frame 0")
    parser.add_argument("--rate", type=float, help="time codes per second (usd); the capture's frames per second by default")


def export(a: Namespace) -> None:
    """`neuspring export`."""
    from neuspring.export.source import chosen_frames, read_source

    writer, default, name = FORMATS[a.to]
    module, _, function = writer.partition(".")
    if a.rate is not None and a.to != "usd":
        raise InputError("--rate", "is for usd", f"--to {a.to}", "Leave it out: the files say the time of each frame.")
    source = read_source(a.twin)
    frames = chosen_frames(a.frames, source, default)
    output = a.output or Path("export") / name.format(name=source.name)
    own = {"rate": a.rate} if a.to == "usd" else {}
    for path in getattr(importlib.import_module(f"neuspring.export.{module}"), function)(source, frames, output, **own):
        print(f"Wrote {path}")
