"""Subject of a figure: an observed scene seen by one camera of any position, and predictions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from neuspring.core.artifacts import Observations, Scenario, Twin, Up, up_sign
from neuspring.core.errors import InputError
from neuspring.data.camera import Camera

VIEW_SIZE = 1200
"""Image size, px, of a free camera (`seen_from`); only a part of the image is shown."""
OPENING = math.radians(20)
"""Angle of view of a free camera: a long lens, so that near and far parts have almost the same scale."""
STEEPEST = 89.0
"""Largest elevation, degrees; in a vertical view, the up direction of the image would be undefined."""
VIEW_ELEVATION = 25.0
"""Default elevation, degrees above the horizon."""
VIEW_MARGIN = 0.04
"""Margin around the shown points, as a fraction of their larger side."""
FLATTEST_PANEL, TALLEST_PANEL = 0.35, 1.3
"""Smallest and largest ratio of a panel's height to its width."""


def broad_side(points: np.ndarray, up: Up) -> float:
    """Azimuth, degrees, that shows the broadest side of points [P, 3], m: a view along their smallest horizontal extent."""
    flat = np.asarray(points, float)[:, :2]
    x, y = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][-1] if len(flat) > 1 else (0.0, -1.0)
    # Of the two opposite views, use the one from negative y, so that all views of a scene agree.
    x, y = (x, y) if y < 0 else (-x, -y)
    return math.degrees(math.atan2(up_sign(up) * y, x))


def seen_from(points: np.ndarray, up: Up, azimuth: float, elevation: float) -> Camera:
    """A camera named "view" whose image contains all points [P, 3], m.

    Its position has the `azimuth`, degrees around the vertical axis, counter-clockwise from +x as seen from above, and the
    `elevation`, degrees above the horizon. Raises InputError for impossible angles.
    """
    if not math.isfinite(azimuth):
        raise InputError("--azimuth", "must be an angle in degrees", azimuth)
    if not abs(elevation) <= STEEPEST:
        raise InputError("--elevation", f"must be {-STEEPEST:g} to {STEEPEST:g} degrees", elevation)
    points, sign = np.asarray(points, float), up_sign(up)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    a, e = math.radians(azimuth), math.radians(elevation)
    forward = -np.array([math.cos(e) * math.cos(a), sign * math.cos(e) * math.sin(a), sign * math.sin(e)])
    right = np.cross(forward, [0.0, 0.0, sign])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    local = (points - middle) @ axes
    # A point is visible if its lateral offset is at most its depth times the tangent of half the angle of view.
    slope = math.tan(OPENING / 2)
    away = float((np.abs(local[:, :2]).max(axis=1) / slope - local[:, 2]).max())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, middle - max(1.05 * away, 0.05) * forward
    focal = 0.5 * VIEW_SIZE / slope
    half = 0.5 * (VIEW_SIZE - 1)
    return Camera("view", VIEW_SIZE, VIEW_SIZE, np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]]), pose)


def box_around(pixels: np.ndarray, camera: Camera, *, clip: bool) -> tuple[int, int, int, int]:
    """Box (left, top, right, bottom; exclusive end) around pixels [P, 2] with a margin.

    The box is enlarged to the aspect ratios FLATTEST_PANEL to TALLEST_PANEL. `clip` restricts it to the image, as photos require.
    """
    low, high, full = pixels.min(axis=0), pixels.max(axis=0), (camera.width, camera.height)
    size = np.maximum(high - low, 1.0)
    size = size + 2 * VIEW_MARGIN * size.max()
    size[1] = max(size[1], FLATTEST_PANEL * size[0])
    size[0] = max(size[0], size[1] / TALLEST_PANEL)
    ends = np.floor(0.5 * (low + high - size)), np.ceil(0.5 * (low + high + size))
    (left, top), (right, bottom) = (np.clip(end, 0, full) if clip else end for end in ends)
    return int(left), int(top), int(right), int(bottom)


def part(camera: Camera, box: tuple[int, int, int, int]) -> Camera:
    """The camera whose image is this box of a camera's image."""
    left, top, right, bottom = box
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= left, top
    return replace(camera, width=right - left, height=bottom - top, intrinsics=intrinsics)


@dataclass(frozen=True, eq=False)
class ShownRun:
    """The prediction of a run: F frames, N nodes."""

    label: str
    positions: np.ndarray
    """Nodes [F, N, 3], m; fewer frames than the scenario if the rollout diverged."""
    twin: Twin | None = None


@dataclass(frozen=True, eq=False)
class ShownScene:
    """The observed scene, seen by one camera; `box` is the shown part of its image."""

    observations: Observations
    camera: Camera
    box: tuple[int, int, int, int]

    @classmethod
    def from_side(
        cls,
        observations: Observations,
        takes: Sequence[ShownRun],
        frames: Sequence[int],
        azimuth: float | None = None,
        elevation: float = VIEW_ELEVATION,
    ) -> Self:
        """The scene from any side (`seen_from`, degrees) with all content of these frames; default azimuth: `broad_side`."""
        points, up = shown_points(observations, takes, frames), observations.scenario.up
        camera = seen_from(points, up, broad_side(points, up) if azimuth is None else azimuth, elevation)
        return cls(observations, camera, box_around(camera.project(points)[0], camera, clip=False))

    @cached_property
    def view(self) -> Camera:
        """The camera of the shown part of the image."""
        return part(self.camera, self.box)

    def hands(self, frame: int) -> np.ndarray:
        """Controllers [C, 3], m, that hold the object in a frame."""
        valid = self.observations.controller_valid
        points = self.observations.controller_points[frame]
        return np.asarray(points[valid[frame]] if valid.size else points)


def shown_points(observations: Observations, takes: Sequence[ShownRun], frames: Sequence[int]) -> np.ndarray:
    """Points [P, 3], m, that figures of these frames must show: all observed points, and predicted points near them."""
    rows = list(frames)
    seen = [observations.object_points[frame][observations.object_visibility[frame]] for frame in rows]
    observed = np.concatenate([*seen, observations.controller_points[rows].reshape(-1, 3)]).astype(float)
    if 0 in rows:
        observed = np.concatenate([observed, observations.nodes])
    # A diverging prediction must not shrink the scene to a dot.
    low, high = observed.min(axis=0), observed.max(axis=0)
    reach = 0.25 * float((high - low).max())
    near = [
        np.clip(take.positions[frame], low - reach, high + reach) for take in takes for frame in rows if frame < len(take.positions)
    ]
    return np.concatenate([observed, *near])


def chosen_frames(scenario: Scenario, frames: int) -> dict[int, str]:
    """Frames to show, in order, with their names. The trajectory has `frames` frames; fewer than the scenario if it diverged."""
    last = scenario.frame_count - 1
    # If two entries are the same frame, the later entry names it.
    named = {
        (scenario.train_end + last) // 2: "middle of the future",
        last: "last frame",
        scenario.train_end - 1: "end of training",
        0: "start",
    }
    shown = {frame: name for frame, name in named.items() if frame < frames}
    if frames <= last:
        shown.setdefault(frames - 1, "last before divergence")
    return dict(sorted(shown.items()))
