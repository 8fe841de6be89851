"""Newton: a script that makes its model of a twin, beside the plain export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.formats import npz
from neuspring.extensions.exports.source import Source, require_start

SCRIPT = Path(__file__).parents[1] / "newton_twin.py"


def write(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz, description.json and newton_twin.py to the folder `output`."""
    require_start(frames)
    if source.twin.rod is not None:
        rule = "Newton's model is of nodes and springs"
        raise InputError("--to newton", rule, f"{source.name}, whose twin is a rod", "Take --to mujoco, or a run with a lattice.")
    if source.twin.topology.pushes.any():
        rule = "Newton's springs pull as well as push"
        raise InputError("--to newton", rule, f"{source.name}, whose hands only push", "Take --to mujoco or npz.")
    write_text(output / SCRIPT.name, SCRIPT.read_text(encoding="utf-8"))
    return [*npz.write(source, frames, output), output / SCRIPT.name]


export = Export(write=write, name="{name}_newton")
