"""The command `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError
from neuspring.extensions.exports import EXPORTS


def export(
    twin: Annotated[Positional[Path], arg(help="folder of a run, results/<scenario>/<method>/<seed>, or a twin.npz")],
    to: Annotated[str, arg(help=f"format: {', '.join(EXPORTS)}")],
    output: Annotated[Path | None, arg(help="file or folder to write; default: in export/, with the name of the run")] = None,
    frames: Annotated[str | None, arg(help="FIRST, FIRST:STOP or FIRST:STOP:STEP; default: all, for ply 0")] = None,
    mass: Annotated[float | None, arg(help="total mass, kg; scales masses and forces; default: mass in capture.json")] = None,
) -> None:
    """Write a twin in the format of another tool."""
    from neuspring.extensions.exports.source import chosen_frames, read_source

    if to not in EXPORTS:
        raise InputError("--to", f"must be one of {', '.join(EXPORTS)}", to)
    format = EXPORTS[to]
    source = read_source(twin, mass)
    target = output or Path("export") / format.name.format(name=source.name)
    for path in format.write(source, chosen_frames(frames, source, format.frames), target):
        print(f"Wrote {path}")
    print(f"Mass: {source.weight}\n{format.then.format(output=target)}")
