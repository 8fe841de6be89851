"""Newton: a script that builds and simulates a model of Newton, and the files of the format `npz`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.extensions.exports import Export, of_body
from neuspring.extensions.exports.formats import npz
from neuspring.extensions.exports.source import ExportSource, require_start

SCRIPT = Path(__file__).parents[1] / "newton_twin.py"


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz, description.json and newton_twin.py to the folder `output`."""
    require_start(frames)
    if source.twin.topology.pushes.any():
        rule = "Newton has no springs that only push"
        raise InputError("--to newton", rule, f"{source.name}, whose hands only push", "Use --to mujoco or npz.")
    of_body(source.twin, "newton")
    script = output / SCRIPT.name
    write_text(script, SCRIPT.read_text(encoding="utf-8"))
    return [*npz.write(source, frames, output), script]


export = Export(
    write=write,
    name="{name}_newton",
    then="Next: PYTHONPATH={output} .venv/bin/python -c \"import newton_twin; print(newton_twin.simulate('{output}', 10))\"",
)
