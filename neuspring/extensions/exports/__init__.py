"""Twins in the formats of other tools. The page for users is README.md.

Each module of `formats/` defines one format in its variable `export`. An installed package adds formats by entry points of the
group `neuspring.exports`. `source` reads the run or twin; `newton_twin` is a script that the format `newton` copies.
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
    """A format for twins."""

    write: Callable[..., list[Path]]
    """(source, frames, output) -> paths of the written files."""
    frames: str = ""
    """Default of `--frames`; empty: all frames."""
    name: str = "{name}"
    """Default file or folder; {name} is the name of the run."""
    then: str = "Next: open {output}"
    """The user's next move, which the command prints at its end; {output} is the file or folder."""


BODY_EXPORTS: Registry[Callable[..., Any]] = Registry("body_exports", {})
"""BODY.FORMAT -> function that writes a body other than the lattice; entry points of the group `neuspring.body_exports`."""


def of_body(twin: Twin, format: str) -> Callable[..., Any] | None:
    """The function that writes the body of a twin in a format; None for a lattice. Raises InputError if the format has none."""
    body = body_of(twin).name
    if twin.body is None:
        return None
    if f"{body}.{format}" not in BODY_EXPORTS:
        raise InputError(f"--to {format}", "the twin must be a lattice", body, "Use --to npz.")
    return BODY_EXPORTS[f"{body}.{format}"]


EXPORTS: Registry[Export] = Registry("exports", modules(f"{__name__}.formats", "export"), Export)
