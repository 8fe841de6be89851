"""The command `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError
from neuspring.extensions.exports import EXPORTS


def export(
    twin: Annotated[Positional[Path], arg(help="a run's folder, results/<scenario>/<method>/<seed>, or a twin.npz")],
    to: Annotated[str, arg(help=f"format: {', '.join(EXPORTS)}")],
    output: Annotated[Path | None, arg(help="file or folder to write; by default it is named after the run")] = None,
    frames: Annotated[str | None, arg(help="FIRST, FIRST:STOP or FIRST:STOP:STEP; all by default, or 0 for ply")] = None,
    mass: Annotated[float | None, arg(help="kg in all, which masses and forces get; by default as capture.json says")] = None,
) -> None:
    """A twin -> a file of another tool, by format."""
    from neuspring.extensions.exports.source import chosen_frames, read_source

    if to not in EXPORTS:
        raise InputError("--to", f"must be one of {', '.join(EXPORTS)}", to)
    format = EXPORTS[to]
    source = read_source(twin, mass)
    target = output or Path("export") / format.name.format(name=source.name)
    for path in format.write(source, chosen_frames(frames, source, format.frames), target):
        print(f"Wrote {path}")
    print(f"Mass: {source.weight}")
