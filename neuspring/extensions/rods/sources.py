"""The sources of recordings of long thin objects: motion capture of cables, and tables of poses with markers."""

from __future__ import annotations

import re

from neuspring.config import ScenarioRow, parse
from neuspring.scenes.sources import Source

RECORDING = re.compile(r"(?P<cable>[A-Za-z0-9][\w.-]*)_(?P<part>train|eval)_(?P<number>\d+)")
"""Name of a recording of DEFORM's data set, whose file is CABLE/PART/NUMBER.pkl."""


def row_of(name: str) -> ScenarioRow | None:
    """The scenario of a recording of a cable; the name gives the path: DLO3_train_15 is DLO3/train/15.pkl."""
    if not (match := RECORDING.fullmatch(name)):
        return None
    values = {
        "scenario": name,
        "source": "mocap",
        "category": match["cable"],
        "path": f"{match['cable']}/{match['part']}/{match['number']}.pkl",
        "self_collision": False,
        "ground": False,
    }
    return parse(ScenarioRow, values, f"scenario {name}")


MOCAP = Source(module="neuspring.extensions.rods.mocap", reads=("data_root", "mocap"), row_of=row_of)
POSED = Source(module="neuspring.extensions.rods.posed", reads=("data_root", "posed"))
