"""Lifted tracks and shape prior -> observations: one structure point per voxel, tracks for scoring from the capture."""

from __future__ import annotations

import numpy as np

from neuspring.config import ScenarioRow
from neuspring.config.perception import Perception
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.records import digest_file
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception.results import LiftedTracks, ShapePrior
from neuspring.perception.sample import on_table, structure


def assemble(row: ScenarioRow, capture: Capture, lifted: LiftedTracks, prior: ShapePrior, settings: Perception) -> Observations:
    """What every method reads. Points that are invisible are zero."""
    up = 1.0 if capture.description.up == "+z" else -1.0
    indices, surface, interior, voxel = structure(lifted, prior, settings.sample, up, settings.seed)
    visible = lifted.object_visibility[:, indices]
    points = np.where(visible[..., None], on_table(lifted.object_points[:, indices], up), 0.0)
    origin = {
        CAPTURE: f"sha256:{digest_file(capture.folder / CAPTURE)}",
        "lift": lifted.backend,
        "shape prior": prior.backend,
    }
    if settings.sample.nodes is not None:
        origin["node spacing"] = f"{voxel:.6g} m"
    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source=row.source,
            category=row.category,
            frame_count=capture.frame_count,
            train_end=capture.train_end,
            frame_rate=capture.description.frame_rate,
            up=capture.description.up,
            self_collision=row.self_collision,
            ground=row.ground,
            obstacles=capture.description.obstacles,
            provenance=capture.description.provenance | origin,
        ),
        object_points=points,
        object_visibility=visible,
        object_motion_valid=lifted.object_motion_valid[:, indices],
        controller_points=lifted.controller_points,
        controller_valid=lifted.controller_valid,
        surface_points=surface,
        interior_points=interior,
        tracks=capture.tracks(),
    )
