"""Lifted tracks and shape prior -> observations: one structure point per voxel, tracks for scoring from the capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.config import ScenarioRow
from neuspring.config.perception import Perception
from neuspring.core.artifacts import ImageObservations, Observations, Scenario
from neuspring.core.records import digest_file
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception.results import LiftedTracks, ShapePrior
from neuspring.perception.sample import on_table, structure


def assemble(
    row: ScenarioRow,
    capture: Capture,
    lifted: LiftedTracks,
    prior: ShapePrior,
    settings: Perception,
    image: ImageObservations | None = None,
) -> Observations:
    """What every method reads. Points that are invisible are zero. `image` is the evidence of color alone, of all tracks."""
    up = 1.0 if capture.description.up == "+z" else -1.0
    # In the image every node should have a track that is followed for long.
    followed = None if image is None else image.visible.sum(axis=0)
    indices, surface, interior, voxel = structure(lifted, prior, settings.sample, up, settings.seed, followed)
    if image is not None:
        image = replace(image, pixels=image.pixels[:, indices], visible=image.visible[:, indices])
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
        image=image,
    )
