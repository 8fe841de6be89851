"""Stage `appearance`: frame 0 of a capture -> Gaussian splats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neuspring.config import Config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.stages.stage import Written, paths, require_length, stage

if TYPE_CHECKING:
    from neuspring.config.images import Images
    from neuspring.data.results import Masks, ShapePrior
    from neuspring.splats.losses import Shot

BESIDE_HANDS, SAME_SURFACE = 6, 0.02
"""BESIDE_HANDS: margin around hands, pixels of an image of `losses.REFERENCE_WIDTH`, in which points may have a hand's color
because mask borders are inexact. SAME_SURFACE: largest difference, m, between a pixel's depth and the point that it shows."""
NEAR_SEEN = 1.5
"""Distance in pixel widths within which a point of the shape prior duplicates an observed point."""


@stage(
    output="{scenario}/{looks}/{seed}/appearance.json",
    reads=lambda settings, given: (
        *("images.backend", "images.appearance"),
        # Processed data have masks that perception has not lifted.
        *(() if given.get("lifted") else ("perception.lift",)),
    ),
    gpu=True,
    memory_mb=8000,
    minutes=240,
    when=lambda rows: rows.images,
    # For videos, the record of perception contains more initial points than the observations.
    without=lambda rows: ("observations",) if rows.source.films else (),
    shared=lambda config, row: None if row.appearance is None else config.images.appearance,
)
def appearance(
    capture: Capture,
    masks: Sequence[Before],
    settings: Config,
    run: Recorder,
    lifted: Before | None = None,
    observations: Observations | None = None,
    seed: int = 0,
    device: str = "auto",
) -> Written:
    """Frame 0 of a capture -> splats: splats.ply, history.parquet, appearance.png.

    The initial splats are at the points and the shape prior of perception (`lifted`). For processed data, they are at the lifted
    masks and the surface points of `observations`.
    """
    import pandas as pd

    from neuspring.core.files import read_npz, write_table
    from neuspring.data.results import masks_of_cameras
    from neuspring.draw import images as figures
    from neuspring.splats.draw import orbit_view, picture
    from neuspring.splats.model import Gaussians
    from neuspring.splats.rasterize import choose_backend
    from neuspring.splats.train import first_splats, train

    images = settings.images
    masks_of = masks_of_cameras(capture, paths(masks))
    backend = choose_backend(images.backend, device)
    estimated = read_npz(lifted.file("depth"))[0] if lifted is not None and lifted.has("depth") else {}
    depths = {name: estimated.get(name, capture.depth(name, 0)) for name in capture.cameras}
    shots = _shots(capture, masks_of, images, device, depths)
    width = float(np.nanmedian([shot.pixel_width for shot in shots]))
    surface = _surface(capture, masks_of, settings, seed, width, lifted, observations)
    beside = beside_hands(capture, masks_of, depths, surface.cloud)
    # If all points are near hands, there are no others to start from.
    if 0 < beside.sum() < len(beside):
        print(f"{beside.sum()} of {len(beside)} points are next to hands; no splats are initialized there", flush=True)
        surface = replace(surface, cloud=surface.cloud[~beside], colors=surface.colors[~beside])
    _require_outside(capture, np.concatenate([surface.cloud, surface.prior]))
    start = images.appearance.start
    points, colors = surface.first(start)
    trained = train(first_splats(points, colors, images.appearance, width), shots, images.appearance, seed, backend)
    files = run.beside(splats="splats.ply", history="history.parquet", picture="appearance.png")
    trained.splats.save(files["splats"])
    write_table(pd.DataFrame(trained.history).melt("step", var_name="metric", value_name="value"), files["history"])
    gaussians = Gaussians.of(trained.splats, device)
    views = {shot.name: picture(gaussians, shot.view, backend) for shot in shots}
    around = {angle: orbit_view(gaussians, shots[0].view, backend, angle) for angle in (90, 180, 270)}
    figures.appearance_figure(shots, views, around, files["picture"])
    hidden = {shot.name: _behind_hands(shot, views[shot.name]) for shot in shots}
    facts: dict[str, Any] = {
        "splats": len(trained.splats.means),
        "first_splats": trained.first,
        "points_beside_hands": int(beside.sum()),
        "start": "seen: no shape prior" if start == "shape_prior" and not surface.has_prior else start,
        "iterations": images.appearance.iterations,
        "loss": trained.history["loss"][-1],
        "backend": backend,
        "cameras": [shot.name for shot in shots],
        "unseen_surface": surface.hidden,
        **{f"psnr_{shot.name}": _quality(shot, views[shot.name]) for shot in shots},
        **{f"behind_hands_{name}": share for name, share in hidden.items()},
    }
    unseen = "an unknown fraction (no shape prior)" if surface.hidden is None else f"{surface.hidden:.0%}"
    hands = ", ".join(f"camera {name} {share:.0%}" for name, share in hidden.items())
    print(f"{facts['splats']} splats; {unseen} of the surface is not visible in frame 0; covered by hands: {hands}", flush=True)
    return Written(files=files, facts=facts)


def beside_hands(capture: Capture, masks: Mapping[str, Masks], depths: Mapping[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """True for points [P, 3], m, that any camera shows in frame 0 in or next to the mask of a hand or a person.

    `depths`: depth [H, W], m, of frame 0 by camera, which decides whether a pixel shows a point.
    """
    import cv2

    from neuspring.splats.losses import REFERENCE_WIDTH

    beside = np.zeros(len(points), bool)
    for name, camera in capture.cameras.items():
        side = 2 * max(round(BESIDE_HANDS * camera.width / REFERENCE_WIDTH), 1) + 1
        near = cv2.dilate((masks[name].labels[0] >= HANDS).astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        pixels, distance = camera.project(points.astype(float))
        shown = camera.sees(pixels) & (distance > 0)
        x, y = np.round(pixels[shown]).astype(int).T
        beside[shown] |= near[y, x] & (np.abs(depths[name][y, x] - distance[shown]) < SAME_SURFACE)
    return beside


def _shots(
    capture: Capture, masks: Mapping[str, Masks], images: Images, device: str, depths: Mapping[str, np.ndarray]
) -> list[Shot]:
    """Training views of frame 0, with `depths` [H, W], m, by camera; cameras that do not show the object are left out."""
    from neuspring.splats.draw import view_of
    from neuspring.splats.losses import HAND_MARGIN, REFERENCE_WIDTH, Shot

    shots = []
    for name, camera in capture.cameras.items():
        labels = masks[name].labels[0]
        margin = HAND_MARGIN * camera.width / REFERENCE_WIDTH
        seen = (capture.color(name, 0), labels == OBJECT, labels >= HANDS, depths[name])
        if (shot := Shot.of(name, view_of(camera, device), *seen, margin)) is None:
            print(f"camera {name}: the object is not visible in frame 0; this camera is not used for splats", flush=True)
        else:
            shots.append(shot)
    if not shots:
        rule = "at least one camera must show the object in frame 0, away from hands"
        raise InputError(f"{capture.folder}, masks of frame 0", rule, "empty masks", "Check perception/<camera>/masks.png.")
    return shots


@dataclass(frozen=True)
class _Surface:
    """Known points of the object's surface in frame 0."""

    cloud: np.ndarray
    """Observed points [P, 3], m."""
    colors: np.ndarray
    """RGB of the observed points [P, 3]."""
    prior: np.ndarray
    """Points on the surface of the shape prior [Q, 3], m."""
    reach: float
    """Distance, m, within which a point of the prior duplicates an observed point."""
    hidden: float | None
    """Fraction of the surface that no camera saw, from the record of perception; None: unknown without a prior."""

    def first(self, start: Literal["seen", "shape_prior"]) -> tuple[np.ndarray, np.ndarray]:
        """Centers of the initial splats [R, 3], m, and their RGB [R, 3]."""
        distance, nearest = self._to_cloud
        if start == "shape_prior" and self.has_prior:
            return self.prior, self.colors[nearest]
        # Points of the prior complete the observed ones; they get the color of the nearest observed point.
        new = distance > self.reach
        return np.concatenate([self.cloud, self.prior[new]]), np.concatenate([self.colors, self.colors[nearest[new]]])

    @property
    def has_prior(self) -> bool:
        """True if the prior has enough points to initialize splats."""
        from neuspring.splats.train import SCALE_NEIGHBORS

        return len(self.prior) > SCALE_NEIGHBORS

    @cached_property
    def _to_cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance, m, and index of the nearest observed point for each point of the prior [Q]."""
        from scipy.spatial import cKDTree

        distance, nearest = cKDTree(self.cloud).query(self.prior)
        return distance, nearest


def _surface(
    capture: Capture,
    masks: Mapping[str, Masks],
    settings: Config,
    seed: int,
    width: float,
    before: Before | None,
    observations: Observations | None,
) -> _Surface:
    """The surface from the record of perception, or from masks and processed observations; `width`: pixel width, m."""
    from neuspring.data.results import LiftedTracks, ShapePrior
    from neuspring.perception.lift import clean_masks

    if before is not None:
        lifted, prior = LiftedTracks.load(before.file("lifted")), ShapePrior.load(before.file("shape"))
        apart = max(settings.images.appearance.spacing, 1.0) * width
        return _Surface(
            lifted.cloud,
            lifted.cloud_colors,
            _surface_points(prior, apart, seed),
            NEAR_SEEN * width,
            prior.facts.get("invented_share"),
        )
    if observations is None:
        raise InputError("--lifted, --observations", "one of the two is required", "neither")
    require_length(capture, observations)
    _, cloud, colors = clean_masks(capture, masks, settings.perception.lift.neighborhood, frames=1)
    if not len(cloud):
        raise InputError(capture.folder, "the object's masks of frame 0 must contain pixels with usable depth", "none")
    return _Surface(cloud, colors, observations.surface_points, NEAR_SEEN * width, None)


def _surface_points(prior: ShapePrior, apart: float, seed: int) -> np.ndarray:
    """Random points [Q, 3] on the prior's surface, one per square of side `apart`, m."""
    if not len(prior.faces):
        return np.zeros((0, 3))
    import trimesh

    mesh = trimesh.Trimesh(prior.vertices, prior.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, max(int(mesh.area / apart**2), 1), seed=seed)
    return np.asarray(points)


def _behind_hands(shot: Shot, drawn: np.ndarray) -> float:
    """Fraction of the rendered splats that hands cover."""
    from neuspring.splats.draw import OBJECT_COVERAGE

    cover = drawn[..., 3] >= OBJECT_COVERAGE
    return float((cover & (shot.known.cpu().numpy() == 0)).sum() / max(cover.sum(), 1))


def _quality(shot: Shot, drawn: np.ndarray) -> float:
    """PSNR of a training view, dB."""
    import torch

    from neuspring.scores.pictures import psnr

    splats = torch.tensor(drawn[..., :3].astype(np.float32) / 255) * shot.known.cpu()[..., None]
    return float(psnr(splats.permute(2, 0, 1), shot.color.cpu().permute(2, 0, 1)))


def _require_outside(capture: Capture, points: np.ndarray) -> None:
    """Raise InputError for a camera inside the object's bounding box, whose pose must be wrong."""
    low, high = points.min(axis=0), points.max(axis=0)
    for name, camera in capture.cameras.items():
        center = camera.camera_to_world[:3, 3]
        if ((center > low) & (center < high)).all():
            rule = f"cameras.{name}.camera_to_world: the camera must be outside the object"
            remedy = "Poses are camera-to-world, in meters. Check for an inverted pose and for its unit."
            raise InputError(capture.folder / CAPTURE, rule, np.round(center, 3).tolist(), remedy)
