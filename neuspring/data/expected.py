"""What is known of a scenario's body before its data are read, for the plan of a run. No result depends on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, read_description
from neuspring.data.cases import released_cases


@dataclass(frozen=True, kw_only=True)
class Expected:
    """A body, its hands and its recording."""

    nodes: int
    spacing: float
    """Distance between neighboring nodes, m."""
    frames: int
    controllers: int = 30
    frame_rate: float = 30.0
    """Frames per second."""


RELEASED_VOXEL = 0.005
"""Spacing of the nodes of PhysTwin's released cases, m."""
USUAL = Expected(nodes=4971, spacing=RELEASED_VOXEL, frames=89)
"""Medians of the released cases, for captures of which nothing is known."""
SYNTHETIC_VOXEL, PLUSH = 0.018, 652
SYNTHETIC_NODES = {"rope": 38, "cloth": 224, "package": 224}
"""Category -> nodes of the demo's scenes at that spacing, m; all others are plush animals, as the demo's sloth."""
TOYS = {"rope": (124, 0.02, 3), "cloth": (225, 0.02, 6), "blob": (174, 0.025, 4)}
"""Nodes, spacing [m] and controllers of the toy scenes' shapes."""
CABLE, GRIPS, RECORD_RATE, SAMPLES = 1.0, 4, 100.0, 500
"""Length of a cable of the motion capture, m; its held markers; samples per second and in all."""


def expected(row: ScenarioRow, config: Config) -> Expected:
    """The body of a scenario. Sources that are not known here are taken to be like the released cases."""
    return BODIES.get(row.source, _released)(row, config)


def _released(row: ScenarioRow, config: Config) -> Expected:
    facts = released_cases().get(Path(row.path).name)
    if facts is None:
        return USUAL
    return replace(USUAL, nodes=int(facts["nodes"] or facts["object_points"]), frames=int(facts["frames"]))


def _filmed(row: ScenarioRow, config: Config) -> Expected:
    return _resampled(_released(row, config), config)


def _captured(row: ScenarioRow, config: Config) -> Expected:
    """A body like the released ones, in a recording as capture.json describes it."""
    try:
        recording = read_description(Path(config.data_root or ".") / row.path / CAPTURE)
    except InputError:
        return _filmed(row, config)
    return replace(_filmed(row, config), frames=recording.frame_count, frame_rate=recording.frame_rate)


def _resampled(body: Expected, config: Config) -> Expected:
    """A body with one node per voxel. Most nodes lie on the surface, so their number goes with 1 / spacing^2."""
    voxel, most = config.perception.sample.voxel, config.perception.sample.nodes
    if most is not None:
        voxel = max(voxel, body.spacing * math.sqrt(body.nodes / most))
    return replace(body, nodes=max(round(body.nodes * (body.spacing / voxel) ** 2), 2), spacing=voxel)


def _synthetic(row: ScenarioRow, config: Config) -> Expected:
    full = _released(row, config).frames
    frames = min(full, config.synthetic.frames or full)
    nodes = SYNTHETIC_NODES.get(row.category, PLUSH)
    return _resampled(replace(USUAL, nodes=nodes, spacing=SYNTHETIC_VOXEL, frames=frames), config)


def _toy(row: ScenarioRow, config: Config) -> Expected:
    nodes, spacing, controllers = TOYS[row.path.partition("/")[0]]
    toy = config.toy
    return Expected(nodes=nodes, spacing=spacing, controllers=controllers, frames=toy.frames, frame_rate=toy.frame_rate)


def _mocap(row: ScenarioRow, config: Config) -> Expected:
    mocap = config.mocap
    rings = mocap.rings or round(CABLE / mocap.spacing) + 1
    recorded = max(math.ceil((SAMPLES - mocap.start) / mocap.stride), 1)
    return Expected(
        nodes=rings * mocap.ring,
        spacing=CABLE / (rings - 1),
        controllers=GRIPS * (1 + (mocap.ring if mocap.grip == "clamp" else 0)),
        frames=min(recorded, mocap.frames or recorded),
        frame_rate=RECORD_RATE / mocap.stride,
    )


BODIES: dict[str, Callable[[ScenarioRow, Config], Expected]] = {
    "toy": _toy,
    "mocap": _mocap,
    "synthetic": _synthetic,
    "capture": _captured,
    "phystwin_raw": _filmed,
    "phystwin": _released,
}
