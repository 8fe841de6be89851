"""Masks and tracks of one camera without depth -> points of frame 0 in the world, a shape, and evidence in the image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from neuspring.config.perception import Perception
from neuspring.core.artifacts import ImageObservations
from neuspring.data.capture import OBJECT, Capture
from neuspring.perception.color.evidence import lift_color
from neuspring.perception.color.first_frame import FirstFrame
from neuspring.perception.results import LiftedTracks, Masks, PixelTracks, ShapePrior
from neuspring.perception.shape_prior import no_prior, shape_prior


@dataclass(frozen=True, eq=False)
class Supposed(Capture):
    """A capture whose depth in frame 0 is that of the supposed shape."""

    front: np.ndarray
    """[H, W], m."""

    def depth(self, camera: str, frame: int) -> np.ndarray:
        """Depth [H, W], m."""
        return self.front if frame == 0 else super().depth(camera, frame)


def from_color(
    capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception
) -> tuple[LiftedTracks, ShapePrior, ImageObservations]:
    """What `lift` and `shape_prior` make of captures with depth, and the evidence of the image.

    The prior of ropes and bodies is what lies between their supposed upper side and the table (`first_frame`), or a mesh that is
    placed on the upper side. Sheets have none. Raises InputError without object, hands or tracks.
    """
    name = next(iter(capture.cameras))
    labels = masks[name].labels
    first = FirstFrame.of(capture, labels[0], settings.color)
    lifted, image = lift_color(capture, labels, tracks[name], first, settings.color, settings.lift.controllers)
    supposed = Supposed(capture.folder, capture.description, first.front)
    whole = replace(masks[name], labels=np.where(first.filled, OBJECT, labels[0])[None].astype(np.uint8))
    shape = settings.shape
    if first.kind == "flat" and shape.backend == "auto":
        return lifted, no_prior(), image
    y, x = np.nonzero(first.filled)
    lower = first.camera.lift(np.stack([x, y], axis=1).astype(float), first.back[y, x])
    cloud = lifted.cloud if shape.backend == "mesh" else np.concatenate([lifted.cloud, lower])
    # Behind the upper side all belongs to the object, down to the table.
    prior = shape_prior(supposed, {name: whole}, cloud, replace(shape, back="none"))
    return lifted, replace(prior, backend=f"{prior.backend}, {lifted.backend}"), image
