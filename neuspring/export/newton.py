"""Newton: the plain export, and the script that makes Newton's model of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.export import plain
from neuspring.export.source import Source

SCRIPT = Path(__file__).with_name("newton_twin.py")


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz, description.json and newton_twin.py to the folder `output`."""
    require_start(frames)
    write_text(output / SCRIPT.name, SCRIPT.read_text(encoding="utf-8"))
    return [*plain.write(source, frames, output), output / SCRIPT.name]


def require_start(frames: Sequence[int]) -> None:
    """Raise InputError unless the frames are 0, 1, 2, ...: a simulator needs the hands from the start on."""
    if list(frames) != list(range(len(frames))):
        rule = "a simulator needs the hands of all frames from 0 on"
        raise InputError("--frames", rule, f"{frames[0]} to {frames[-1]}, {len(frames)} frames", "Take 0:STOP, or leave it out.")
