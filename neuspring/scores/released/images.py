"""Checks 4 and 5: which principal point the released points were lifted with, and the scores of pictures of the released splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from neuspring.config.images import ImageQuirks, Images
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.text import Progress
from neuspring.data import phystwin
from neuspring.data.capture import Camera
from neuspring.data.phystwin import CALIBRATION
from neuspring.data.released import (
    Released,
    depth_image,
    gated_lift,
    mirrored,
    read_cameras,
    read_picture,
    read_prediction,
    visible_pixels,
)
from neuspring.scores import metrics
from neuspring.scores.lpips import Lpips
from neuspring.scores.pictures import Pair, picture_scores
from neuspring.scores.released.findings import Absent, Comparison, Tools, of_scores, require
from neuspring.splats.draw import COVERED, picture, prune_by_opacity, skinned_frames, view_of
from neuspring.splats.model import Splats

SCORED = ("psnr", "ssim", "lpips", "iou")
RELEASED = Images(
    # gsplat since version 1.5 has another threshold of coverage than the released evaluation; ours has the same.
    backend="warp",
    released_quirks=ImageQuirks(
        second_camera_intrinsics=True, any_alpha=True, unit_lpips=True, corner_pixels=True, degenerate_skinning=True
    ),
)
"""How the released pictures were made and scored: first view, every quirk."""
LIFTED = 1e-4
"""m: points lifted with the right principal point come back but for rounding; with the other, the nearest is about 1 mm off."""
TRUE, MIRRORED = "c_x", "W - c_x"


def deprojection(case: Released, observations: Observations, _: Tools) -> list[Comparison]:
    """Check 4: lifting the tracked pixels of frame 0 with one of two principal points must give the released points.

    Every released point of frame 0 must have a lifted one close to it, over all cameras. The converse would not hold: the released
    processing drops lifted points.
    """
    require(case.root, case.folder / phystwin.METADATA, case.folder / CALIBRATION)
    cameras = read_cameras(case.folder)
    require(case.root, *(path for c in cameras for path in (case.pixel_tracks(c.name), case.first_depth(c.name))))
    raw = {c.name: (visible_pixels(case.pixel_tracks(c.name)), depth_image(case.first_depth(c.name), c)) for c in cameras}
    residuals = {}
    for convention, used in ((TRUE, cameras), (MIRRORED, [mirrored(c) for c in cameras])):
        lifted = np.concatenate([gated_lift(camera, *raw[camera.name]) for camera in used])
        if not len(lifted):
            raise Absent("no tracked pixel of frame 0 has a depth within the gate")
        residuals[convention] = float(np.median(cKDTree(lifted).query(observations.object_points[0])[0]))
    if max(residuals.values()) <= LIFTED:
        raise Absent(f"c_x and W - c_x give the same points: {residuals[TRUE]:.3g} and {residuals[MIRRORED]:.3g} m")
    better = min(residuals, key=lambda name: residuals[name])
    findings = []
    for convention, residual in residuals.items():
        quantity = f"distance to the points lifted with {convention}"
        file = case.pixel_tracks(cameras[0].name)
        finding = Comparison(check=4, scenario=case.name, quantity=quantity, unit="m", ours=residual, file=file)
        if convention == better:
            note = f"the data follow {convention}" if residual <= LIFTED else "neither fits"
            finding = replace(finding, note=note).against(0.0, LIFTED)
        findings.append(finding)
    return findings


def renderer(case: Released, observations: Observations, tools: Tools) -> list[Comparison]:
    """Check 5: the released splats, moved by the released prediction, drawn and scored as released."""
    calibration = (case.folder / phystwin.METADATA, case.folder / CALIBRATION)
    require(case.root, case.splats, case.prediction, case.object_masks, case.human_masks, case.colors, *calibration)
    rows = frame_scores(case, observations, tools.lpips, tools.device)
    scores = metrics.score_images(rows, observations.scenario, observations.scenario.frame_count, "released", 0)
    missing = {"lpips": f"not computed: {tools.lpips}"} if isinstance(tools.lpips, str) else {}
    return of_scores(Comparison(check=5, scenario=case.name, quantity=""), scores, SCORED, tools.published, missing)


def frame_scores(
    case: Released, observations: Observations, lpips: Lpips | str, device: str, images: Images = RELEASED
) -> pd.DataFrame:
    """Columns frame, camera, metric, value of every frame but the first, seen by the first camera."""
    cameras = read_cameras(case.folder)
    if len(cameras) < 2:
        raise InputError(case.folder / phystwin.METADATA, "a second camera is required: pictures have its intrinsics", len(cameras))
    camera, borrowed = cameras[0], cameras[1] if images.released_quirks.second_camera_intrinsics else None
    view = view_of(camera, images, device, borrowed)
    splats = prune_by_opacity(Splats.load(case.splats), images.opacity)
    positions = read_prediction(case.prediction, observations.scenario.frame_count, len(observations.nodes))
    progress = Progress(f"pictures {case.name}", len(positions))
    rows = []
    for frame, gaussians in enumerate(skinned_frames(splats, positions, images, device)):
        if frame:
            rendered = picture(gaussians, view, "warp")
            values = _scores(case, camera, frame, rendered, lpips, images)
            rows += [{"frame": frame, "camera": camera.name, "metric": name, "value": value} for name, value in values.items()]
        progress.update(frame + 1)
    return pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])


def _scores(
    case: Released, camera: Camera, frame: int, rendered: np.ndarray, lpips: Lpips | str, images: Images
) -> dict[str, float]:
    name, quirks = f"{frame}.png", images.released_quirks
    observed = read_picture(case.colors / name, camera)
    mask = read_picture(case.object_masks / name, camera, gray=True)
    human = read_picture(case.human_masks / name, camera, gray=True)
    pair = Pair.of(observed, rendered, mask, human, 1 if quirks.any_alpha else COVERED)
    return picture_scores(pair, lpips, unit_lpips=quirks.unit_lpips)
