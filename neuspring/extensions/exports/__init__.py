"""A twin in the formats of other tools. README.md here is the page for users.

A format is a file of `formats/` with its `export`; an installed package brings one by an entry point of `neuspring.exports`.
`source` is the run or twin that is exported, `cable` a rod as a chain of rigid edges, `newton_twin` the script that is exported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from neuspring.registry import Registry, modules


@dataclass(frozen=True, kw_only=True)
class Export:
    """A format that twins are written in."""

    write: Callable[..., list[Path]]
    """(source, frames, output) -> paths written; the keyword `rate` (time codes per second) where the format has one."""
    frames: str = ""
    """Frames by default, as `--frames` takes them; empty: all."""
    name: str = "{name}"
    """File or folder by default; {name} is that of the run."""


EXPORTS: Registry[Export] = Registry("exports", modules(f"{__name__}.formats", "export"), Export)
