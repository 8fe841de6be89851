"""What a picture is made of: the scene and its video as one camera sees them, and the predictions that are shown beside it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from neuspring.config.images import Images
from neuspring.core.artifacts import Observations, Twin
from neuspring.data.capture import HANDS, NOTHING, OBJECT, Camera, Capture
from neuspring.report.paper.look import box_around, part
from neuspring.splats.draw import frames_from_centers, skinned_frames
from neuspring.splats.model import Gaussians, Splats

FADE = 0.6
"""Part of white in a photo behind a drawing."""


@dataclass(frozen=True, eq=False)
class Take:
    """A run's prediction: F frames, N nodes."""

    label: str
    positions: np.ndarray
    """Nodes [F, N, 3], m; fewer frames than the scenario where it diverged."""
    twin: Twin | None = None
    splats: Splats | None = None
    centers: np.ndarray | None = None
    """Where the method's own model puts its splats [F, G, 3], m; else the nodes carry them."""

    def gaussians(self, frames: Iterable[int], images: Images, device: str) -> Iterator[tuple[int, Gaussians]]:
        """The splats in these frames, in rising order; frames behind a divergence are left out."""
        assert self.splats is not None
        wanted = {frame for frame in frames if frame < len(self.positions)}
        stop = max(wanted, default=-1) + 1
        if self.centers is None:
            every = skinned_frames(self.splats, self.positions[:stop], images, device) if stop else iter(())
        else:
            every = frames_from_centers(self.splats, self.centers[:stop], device)
        return ((frame, gaussians) for frame, gaussians in enumerate(every) if frame in wanted)


@dataclass(frozen=True, eq=False)
class Scene:
    """What was observed, seen by one camera; `box` is the part of its picture that is shown."""

    observations: Observations
    camera: Camera
    box: tuple[int, int, int, int]
    capture: Capture | None = None
    """The video, where the camera is one of its."""
    labels: np.ndarray | None = None
    """Perceived masks [T, H, W] of the camera, where the capture has none of its own."""

    @classmethod
    def of(
        cls,
        observations: Observations,
        camera: Camera,
        takes: Sequence[Take],
        frames: Sequence[int],
        capture: Capture | None = None,
        labels: np.ndarray | None = None,
    ) -> Scene:
        """The part of the picture that holds what these frames show."""
        pixels, depth = camera.project(shown_points(observations, takes, frames))
        seen = pixels[depth > 0]
        if not len(seen):
            seen = np.array([[0.0, 0.0], [camera.width - 1, camera.height - 1]])
        if capture is not None:
            seen = np.clip(seen, 0, [camera.width - 1, camera.height - 1])
        box = box_around(seen, camera, clip=capture is not None)
        return cls(observations, camera, box, capture, labels)

    @cached_property
    def view(self) -> Camera:
        """The camera of the shown part."""
        return part(self.camera, self.box)

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """The shown part of a picture [H, W, ...]."""
        left, top, right, bottom = self.box
        return picture[top:bottom, left:right]

    def photo(self, frame: int) -> np.ndarray | None:
        """RGB [H, W, 3] uint8 of the whole picture; None: there is none."""
        if self.capture is None or not self.capture.has(self.camera.name, frame):
            return None
        return self.capture.color(self.camera.name, frame)

    def mask(self, frame: int) -> np.ndarray | None:
        """Labels [H, W] of the whole picture; None: there are none."""
        if self.capture is None or not self.capture.has(self.camera.name, frame):
            return None
        if self.capture.description.masks:
            return self.capture.mask(self.camera.name, frame)
        return None if self.labels is None else self.labels[frame]

    @property
    def has_masks(self) -> bool:
        """Whether observed and predicted pictures can be compared."""
        return self.capture is not None and (self.capture.description.masks or self.labels is not None)

    def hands(self, frame: int) -> np.ndarray:
        """Controllers [C, 3], m, that hold the object."""
        valid = self.observations.controller_valid
        points = self.observations.controller_points[frame]
        return np.asarray(points[valid[frame]] if valid.size else points)


def shown_points(observations: Observations, takes: Sequence[Take], frames: Sequence[int]) -> np.ndarray:
    """Points [P, 3], m, that pictures of these frames must show: all observed ones, and predicted ones near them."""
    rows = list(frames)
    seen = [observations.object_points[frame][observations.object_visibility[frame]] for frame in rows]
    real = np.concatenate([*seen, observations.controller_points[rows].reshape(-1, 3)]).astype(float)
    if 0 in rows:
        real = np.concatenate([real, observations.nodes])
    # A prediction far away (before it diverges) must not shrink everything else to a dot.
    low, high = real.min(axis=0), real.max(axis=0)
    reach = 0.25 * float((high - low).max())
    near = [
        np.clip(take.positions[frame], low - reach, high + reach) for take in takes for frame in rows if frame < len(take.positions)
    ]
    return np.concatenate([real, *near])


def over_white(rgba: np.ndarray, below: np.ndarray | None = None) -> np.ndarray:
    """RGB [H, W, 3] uint8 of a picture drawn over black [H, W, 4], laid over white or over the picture `below`."""
    ground = 255.0 if below is None else below.astype(float)
    mixed = rgba[..., :3] + (1 - rgba[..., 3:] / 255.0) * ground
    return np.asarray(np.clip(mixed + 0.5, 0, 255), np.uint8)


def masked(photo: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The photo with white where there is neither the object nor a hand."""
    picture = photo.copy()
    picture[labels == NOTHING] = 255
    return picture


def faded(photo: np.ndarray) -> np.ndarray:
    """A photo that a drawing can be read on: gray, and mostly white."""
    gray = photo.astype(float).mean(axis=2, keepdims=True)
    return np.asarray(np.repeat((1 - FADE) * gray + FADE * 255, 3, axis=2), np.uint8)


def object_and_hands(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masks [H, W] uint8, 0 or 255, of the object and of hands."""
    first, second = (np.where(labels == label, 255, 0).astype(np.uint8) for label in (OBJECT, HANDS))
    return first, second
