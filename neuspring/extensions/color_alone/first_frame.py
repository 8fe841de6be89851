"""The object in frame 0 is its silhouette, lying on the table.

With up as +z, the pixel p shows the object's upper side at height t(p), where its ray meets the plane z = t(p):

    sheets   (flat, such as cloth)           t = SHEET_THICKNESS; nodes lie at t / 2
    ropes    (round), bodies (all others)  t of the nearest of the ellipsoids below, and their lower side is that of the farthest

Each of the largest discs inside the silhouette (`discs`), with center q and radius r, pixels, is an ellipsoid that is
w = 2 k r z / f thick, k = 1 for ropes and BODY_THICKNESS for bodies: thickness follows the outline's width, symmetric about the
medial surface on which the centers lie. f is the focal length, z the depth of the center. Where it lies on the table its center is
at half its thickness above it:

    z = h / (d(q) + k r / f)

h is the height of the camera and d(q) how far the ray of q sinks per meter of depth. What stands would be laid far behind itself
so. Therefore no center is farther from the camera than the upright plane

    a(q) <= min a + FOOTPRINT (max s - min s)

a is the distance along the table in the direction in which the camera looks, s that across, on the plane through the nearest
center. What would be beyond the plane rises in it, above what touches the table. `pose` of the capture says lying (no such plane)
or standing (STANDING_FOOTPRINT): one picture cannot say which. What hangs in the air (`ground: false`) lies in the upright plane
through its nearest point on the table, sheets too: nothing says how far it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.extensions.color_alone.pixels import disc, pixels_of
from neuspring.perception.shape import discs

SILHOUETTES = {"cloth": "flat", "package": "flat", "rope": "round"}
"""Shape of an object by its category: flat is a sheet, round is as thick as it is wide; all others are bodies."""
BENEATH = 0.03
"""Part of the object that a hand hides in frame 0: its pixels between pixels of the object, up to this far from them, m."""
SHEET_THICKNESS = 0.004
"""m."""
BODY_THICKNESS = 0.9
"""Thickness of a body, which is neither sheet nor rope, in local widths of its silhouette; 1: as thick as it is wide."""
FOOTPRINT, STANDING_FOOTPRINT = 1.2, 0.3
"""Farthest that a body reaches away from the camera, measured along the table from its nearest point, in widths of its middle line
across the view; what would lie farther off rises. For a pose that is not given, and a standing one; a lying body rises nowhere."""
ROPE_WIDEST = 1.5
"""Largest thickness of a rope over its median."""
LEVEL_VIEW = 0.35
"""Part of a view's direction that is level, below which the camera looks down on things: nothing rises in its picture."""


@dataclass(frozen=True)
class FirstFrame:
    """Place of the object in frame 0; up is +1 or -1."""

    camera: Camera
    up: float
    kind: str
    """flat, round or body."""
    filled: np.ndarray
    """[H, W] bool: the object, and what of it lies beneath hands."""
    heights: np.ndarray
    """t [H, W], m; 0 outside."""
    lower: np.ndarray
    """Height of the lower side [H, W], m; 0 outside."""
    pixel_size: float
    """Width of a pixel at the object, m (median)."""
    facts: dict[str, float]
    """Suppositions about a rope or a body: `longest`, how far behind its nearest point it would lie on the table, m; `across`,
    its width there, m; and `raised`, the part of its discs that rises instead."""

    @classmethod
    def of(cls, capture: Capture, labels: np.ndarray) -> FirstFrame:
        """From the labels [H, W] of frame 0. Raises InputError without an object in view of the table."""
        camera = next(iter(capture.cameras.values()))
        category = capture.description.category
        kind = SILHOUETTES.get(category, "body")
        if not (labels == OBJECT).any():
            raise InputError(f"{capture.folder}, masks of frame 0", "the object must be in view", "none of its pixels")
        below = camera_depth(camera, pixels_of(labels == OBJECT), 0.0)
        if not (np.isfinite(below) & (below > 0)).all():
            rule = "every pixel of the object in frame 0 must look at the table, z = 0"
            remedy = "Check camera_to_world and up: without depth the table is where they say."
            raise InputError(f"{capture.folder / CAPTURE}, camera_to_world", rule, "some look above the horizon", remedy)
        size = float(np.median(below)) / camera.intrinsics[0, 0]
        filled = beneath_hands(labels, BENEATH / size)
        up = capture.description.up_sign
        hangs, pixels, facts = not capture.description.ground, pixels_of(filled).astype(float), dict[str, float]()
        heights, lower = np.zeros(filled.shape), np.zeros(filled.shape)
        if kind == "flat" and not hangs:
            heights[filled] = SHEET_THICKNESS
            return cls(camera, up, kind, filled, heights, lower, size, facts)
        if kind == "flat":
            middle = upright_depth(camera, pixels)
            found = [middle - SHEET_THICKNESS / 2, middle + SHEET_THICKNESS / 2]
        else:
            bounds = {None: FOOTPRINT, "lying": np.inf, "standing": STANDING_FOOTPRINT}
            footprint = 0.0 if hangs else np.inf if kind == "round" else bounds[capture.description.pose]
            # Where the silhouette is wider than a rope it shows two turns, or a shadow.
            shape = (1.0, footprint, ROPE_WIDEST) if kind == "round" else (BODY_THICKNESS, footprint)
            depth, thick, facts = medial(camera, up, filled, *shape)
            found = [side[filled] for side in inflated(filled, depth, thick)]
        for side, depth in zip((heights, lower), found, strict=True):
            # The table cuts off what would be below it.
            side[filled] = np.maximum(up * camera.lift(pixels, depth)[:, 2], 0.0)
        return cls(camera, up, kind, filled, heights, lower, size, facts)

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, of pixels (x, y) [n, 2]: of a sheet its middle, of others their upper side.

        Pixels outside of the silhouette have the height of its nearest pixel.
        """
        return self._lifted(pixels, 0.5 if self.kind == "flat" else 1.0)

    def fingers(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, where fingers hold the object: a sheet by its upper side, others at half their height.

        There is no point of the object there (`points`): a spring between the two would have no length.
        """
        return self._lifted(pixels, 1.0 if self.kind == "flat" else 0.5)

    def _lifted(self, pixels: np.ndarray, share: float) -> np.ndarray:
        return self.camera.lift(pixels.astype(float), camera_depth(self.camera, pixels, self._up(pixels, share)))

    def _up(self, pixels: np.ndarray, share: float) -> np.ndarray:
        """z at pixels [n], m: of the upper side (share 1), the lower one (0), or between."""
        _, labels = cv2.distanceTransformWithLabels((~self.filled).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        height_of = np.zeros(labels.max() + 1)
        height_of[labels[self.filled]] = self._between(share)[self.filled]
        x, y = np.round(pixels).astype(int).T
        rows, columns = np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)
        return np.asarray(self.up * height_of[labels[rows, columns]])

    def _between(self, share: float) -> np.ndarray:
        return np.asarray(self.lower + share * (self.heights - self.lower))

    def depths(self, share: float) -> np.ndarray:
        """Depth [H, W], m, of the upper side (share 1) or of the lower one (0); 0 outside."""
        filled, depth = self.filled, np.zeros(self.filled.shape)
        depth[filled] = camera_depth(self.camera, pixels_of(filled), self.up * self._between(share)[filled])
        return depth


def medial(
    camera: Camera, up: float, filled: np.ndarray, factor: float, footprint: float, widest: float = np.inf
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Depth [n] and thickness [n], m, of the ellipsoids of the `discs` of a silhouette `filled` [H, W], and `FirstFrame.facts`.

    `factor` is k and FOOTPRINT that of the head of this file; up is +1 or -1. No ellipsoid is thicker than `widest` times the
    median one.
    """
    centers, radii, _ = discs(filled)
    rays = camera.rays(centers)
    # Per meter of depth.
    thick = 2 * factor * radii / camera.intrinsics[0, 0]
    thick = np.minimum(thick, widest * np.median(thick))
    depth = up * camera.camera_to_world[2, 3] / (thick / 2 - up * rays[:, 2])
    x, y = camera.camera_to_world[:2, 2]
    level = max(float(np.hypot(x, y)), 1e-9)
    away, aside = depth * (rays[:, :2] @ (x, y)) / level, depth * (rays[:, :2] @ (-y, x)) / level
    nearest = away.min()
    across, shorter = float(np.ptp(aside)), np.ones(len(away))
    # A camera that looks down sees all of the footprint, and bodies may lie on both sides of it. A body that reaches no farther
    # than it is thick lies in any case.
    if level > LEVEL_VIEW and nearest > 0 and np.ptp(away) > (depth * thick).max() / factor:
        across = max(float(np.ptp(aside * nearest / away)), 1e-6)
        shorter = np.minimum((nearest + footprint * across) / away, 1.0)
    facts = {"longest": float(away.max() - nearest), "across": across, "raised": float((shorter < 1).mean())}
    return shorter * depth, shorter * depth * thick, facts


def camera_depth(camera: Camera, pixels: np.ndarray, z: np.ndarray | float) -> np.ndarray:
    """Depth [n], m along the optical axis, at which the rays of pixels (x, y) [n, 2] meet the planes at z [n]; inf: never."""
    rays = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (z - camera.camera_to_world[2, 3]) / rays[:, 2]
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)


def upright_depth(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Depth [n], m, of pixels (x, y) [n, 2] in the upright plane that faces the camera, through the nearest of them on the table.

    On the table where the camera looks down.
    """
    below, axis = camera_depth(camera, pixels, 0.0), camera.camera_to_world[:2, 2]
    along = camera.rays(pixels)[:, :2] @ axis
    if np.hypot(*axis) <= LEVEL_VIEW or along.min() <= 0:
        return below
    return np.asarray((below * along).min() / along)


def beneath_hands(labels: np.ndarray, reach: float) -> np.ndarray:
    """The object [H, W] bool with what hands hide of it: their pixels that lie between pixels of the object.

    A hand's pixel lies between them if it is in the object's closing by a disc of radius `reach`, pixels.
    """
    radius = max(round(reach), 1)
    padded = np.pad((labels == OBJECT).astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(radius))[radius:-radius, radius:-radius] > 0
    return np.asarray((labels == OBJECT) | (closed & (labels >= HANDS)))


def inflated(mask: np.ndarray, depth: np.ndarray, widest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the front and of the back [H, W], m, of the ellipsoids whose outlines are the `discs` of a silhouette `mask` [H, W].

    The disc at q with radius r belongs to an ellipsoid with its center at `depth` [n] and `widest` [n] thick, m. The pixel p shows
    its surfaces at depth_q -+ widest_q / 2 sqrt(1 - |p - q|^2 / r^2); the front is the nearest of all, the back the farthest.
    Pixels that no disc covers, of pointed corners, are as thick as their distance from the edge says, about the middle of the
    nearest other pixel. Zero outside.
    """
    centers, radii, distance = discs(mask)
    front, back = np.full(mask.shape, np.inf), np.full(mask.shape, -np.inf)
    for (x, y), r, d, w in zip(centers.tolist(), radii.tolist(), depth.tolist(), widest.tolist(), strict=True):
        reach = int(r)
        rows, columns = slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1)
        v, u = np.ogrid[rows.start : min(rows.stop, len(mask)), columns.start : min(columns.stop, mask.shape[1])]
        inside = r * r - (v - y) ** 2 - (u - x) ** 2
        half = np.where(inside > 0, 0.5 * w / r * np.sqrt(np.maximum(inside, 0.0)), np.nan)
        front[rows, columns] = np.fmin(front[rows, columns], d - half)
        back[rows, columns] = np.fmax(back[rows, columns], d + half)
    bare = ~np.isfinite(front)
    nearest = tuple(ndimage.distance_transform_edt(bare, return_distances=False, return_indices=True))
    middle, half = 0.5 * (front[nearest] + back[nearest]), distance * float(np.median(0.5 * widest / radii))
    front, back = np.where(bare, middle - half, front), np.where(bare, middle + half, back)
    return np.where(mask, front, 0.0), np.where(mask, back, 0.0)
