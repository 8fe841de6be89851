"""A twin in the formats of other tools. README.md here is the page for users.

A format is a file of `formats/` with its `export`; an installed package brings one by an entry point of `neuspring.exports`.
`source` is the run or twin that is exported, `newton_twin` the script that is exported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.registry import Registry, modules
from neuspring.twin.body import body_of


@dataclass(frozen=True, kw_only=True)
class Export:
    """A format that twins are written in."""

    write: Callable[..., list[Path]]
    """(source, frames, output) -> paths written."""
    frames: str = ""
    """Frames by default, as `--frames` takes them; empty: all."""
    name: str = "{name}"
    """File or folder by default; {name} is that of the run."""


BODY_EXPORTS: Registry[Callable[..., Any]] = Registry("body_exports", {})
"""BODY.FORMAT -> function that writes a body other than the lattice, from entry points of the group `neuspring.body_exports`."""


def of_body(twin: Twin, format: str) -> Callable[..., Any] | None:
    """The function that writes the body of a twin in a format; None for a lattice. Raises InputError where there is none."""
    body = body_of(twin).name
    if twin.body is None:
        return None
    if f"{body}.{format}" not in BODY_EXPORTS:
        raise InputError(f"--to {format}", "the twin must be a lattice", body, "Take --to npz.")
    return BODY_EXPORTS[f"{body}.{format}"]


EXPORTS: Registry[Export] = Registry("exports", modules(f"{__name__}.formats", "export"), Export)
