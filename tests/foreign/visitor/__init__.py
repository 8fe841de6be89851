"""One member of each of several kinds, as small as they can be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuspring.extensions.exports import Export


def greet(name: str = "world") -> None:
    """Say hello; a command of another package."""
    print(f"hello {name}")


def write_xyz(source: object, frames: Sequence[int], output: Path) -> list[Path]:
    """Nodes of one frame as lines x y z, m."""
    np.savetxt(output.with_suffix(".xyz"), source.positions[frames[0]])
    return [output.with_suffix(".xyz")]


XYZ = Export(write=write_xyz, frames="0")
