"""Shape of the object in frame 0 from its silhouette and the table z = 0.

With up as +z, the ray of pixel p meets the object's upper side at the height t(p):

    sheets (flat, such as cloth)         t = SHEET_THICKNESS; nodes are at t / 2
    ropes (round), bodies (all others)   front of the nearest ellipsoid below; their lower side is the back of the farthest one

Each of the largest discs inside the silhouette (`discs`), with center q and radius r, pixels, becomes an ellipsoid of thickness

    w = 2 k r z / f,   k = 1 for ropes, BODY_THICKNESS for bodies

f is the focal length, z the depth of the center. The object is symmetric about the surface through the centers. The center of an
ellipsoid that rests on the table is at half its thickness:

    z = h / (d(q) + k r / f)

h is the height of the camera, and d(q) the descent of the ray of q per meter of depth. This would place a standing object far
behind its true position. Therefore no center is beyond an upright plane:

    a(q) <= min a + FOOTPRINT (max s - min s)

a is the distance along the table in the viewing direction. s is the distance across, on the plane through the nearest center.
Centers that would be beyond the plane rise in it.

One image does not show the pose, so `pose` of the capture states it: lying (no such plane) or standing (STANDING_FOOTPRINT). An
object in the air (`ground: false`), also a sheet, is in the upright plane through its nearest point on the table, because its
distance is unknown.
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
"""Shape by category: flat for sheets, round for objects as thick as wide; all others are bodies."""
BENEATH = 0.03
"""m: hand pixels between object pixels hide the object in frame 0 if they are within this distance of them."""
SHEET_THICKNESS = 0.004
"""m."""
BODY_THICKNESS = 0.9
"""Thickness of a body relative to the local width of its silhouette."""
FOOTPRINT, STANDING_FOOTPRINT = 1.2, 0.3
"""Largest extent of a body away from the camera, along the table from its nearest point, relative to its width across the view.
For an unknown and for a standing pose; parts farther away rise. A lying body does not rise."""
ROPE_WIDEST = 1.5
"""Largest thickness of a rope relative to its median."""
LEVEL_VIEW = 0.35
"""Horizontal component of the viewing direction below which the camera looks down, and nothing rises."""


@dataclass(frozen=True)
class FirstFrame:
    """Shape of the object in frame 0; up is +1 or -1."""

    camera: Camera
    up: float
    kind: str
    """flat, round or body."""
    filled: np.ndarray
    """[H, W] bool: the object, including parts beneath hands."""
    heights: np.ndarray
    """Height t of the upper side [H, W], m; 0 outside."""
    lower: np.ndarray
    """Height of the lower side [H, W], m; 0 outside."""
    pixel_size: float
    """Median width of a pixel at the object, m."""
    facts: dict[str, float]
    """For ropes and bodies: `longest`, extent behind the nearest point if it were lying, m; `across`, width, m; `raised`,
    fraction of discs that rise."""

    @classmethod
    def of(cls, capture: Capture, labels: np.ndarray) -> FirstFrame:
        """Make it from the labels [H, W] of frame 0. Raises InputError without an object in front of the table."""
        camera = next(iter(capture.cameras.values()))
        category = capture.description.category
        kind = SILHOUETTES.get(category, "body")
        if not (labels == OBJECT).any():
            raise InputError(f"{capture.folder}, masks of frame 0", "the object must be in view", "no object pixel")
        below = camera_depth(camera, pixels_of(labels == OBJECT), 0.0)
        if not (np.isfinite(below) & (below > 0)).all():
            rule = "the ray of each object pixel in frame 0 must meet the table, z = 0"
            remedy = "Check camera_to_world and up: without depth, they determine the table."
            raise InputError(f"{capture.folder / CAPTURE}, camera_to_world", rule, "rays above the horizon", remedy)
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
            sides = [middle - SHEET_THICKNESS / 2, middle + SHEET_THICKNESS / 2]
        else:
            bounds = {None: FOOTPRINT, "lying": np.inf, "standing": STANDING_FOOTPRINT}
            footprint = 0.0 if hangs else np.inf if kind == "round" else bounds[capture.description.pose]
            # A silhouette wider than a rope shows two turns, or a shadow.
            shape = (1.0, footprint, ROPE_WIDEST) if kind == "round" else (BODY_THICKNESS, footprint)
            depth, thick, facts = medial(camera, up, filled, *shape)
            sides = [side[filled] for side in inflated(filled, depth, thick)]
        for side, depth in zip((heights, lower), sides, strict=True):
            # The table cuts off parts below it.
            side[filled] = np.maximum(up * camera.lift(pixels, depth)[:, 2], 0.0)
        return cls(camera, up, kind, filled, heights, lower, size, facts)

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, of pixels (x, y) [n, 2]: the middle of a sheet, the upper side of other objects.

        Pixels outside the silhouette get the height of its nearest pixel.
        """
        return self._lifted(pixels, 0.5 if self.kind == "flat" else 1.0)

    def fingers(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, of a grasp: the upper side of a sheet, half the height of other objects.

        They differ from `points`, because a spring between a controller and a node must have a length.
        """
        return self._lifted(pixels, 1.0 if self.kind == "flat" else 0.5)

    def _lifted(self, pixels: np.ndarray, share: float) -> np.ndarray:
        return self.camera.lift(pixels.astype(float), camera_depth(self.camera, pixels, self._up(pixels, share)))

    def _up(self, pixels: np.ndarray, share: float) -> np.ndarray:
        """z at pixels [n], m, of the upper side (share 1), of the lower side (0), or between."""
        _, labels = cv2.distanceTransformWithLabels((~self.filled).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        height_of = np.zeros(labels.max() + 1)
        height_of[labels[self.filled]] = self._between(share)[self.filled]
        x, y = np.round(pixels).astype(int).T
        rows, columns = np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)
        return np.asarray(self.up * height_of[labels[rows, columns]])

    def _between(self, share: float) -> np.ndarray:
        return np.asarray(self.lower + share * (self.heights - self.lower))

    def depths(self, share: float) -> np.ndarray:
        """Depth [H, W], m, of the upper side (share 1) or of the lower side (0); 0 outside."""
        filled, depth = self.filled, np.zeros(self.filled.shape)
        depth[filled] = camera_depth(self.camera, pixels_of(filled), self.up * self._between(share)[filled])
        return depth


def medial(
    camera: Camera, up: float, filled: np.ndarray, factor: float, footprint: float, widest: float = np.inf
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Depth [n] and thickness [n], m, of the ellipsoids of a silhouette `filled` [H, W], and `FirstFrame.facts`.

    `factor` is k and `footprint` is FOOTPRINT in the equations above; up is +1 or -1. No ellipsoid is thicker than `widest` times
    the median.
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
    # A camera that looks down sees the full footprint, on both sides of its position. An object that reaches no farther than
    # it is thick rests on the table in any case.
    if level > LEVEL_VIEW and nearest > 0 and np.ptp(away) > (depth * thick).max() / factor:
        across = max(float(np.ptp(aside * nearest / away)), 1e-6)
        shorter = np.minimum((nearest + footprint * across) / away, 1.0)
    facts = {"longest": float(away.max() - nearest), "across": across, "raised": float((shorter < 1).mean())}
    return shorter * depth, shorter * depth * thick, facts


def camera_depth(camera: Camera, pixels: np.ndarray, z: np.ndarray | float) -> np.ndarray:
    """Depth [n], m along the optical axis, at which the rays of pixels (x, y) [n, 2] meet the planes at z [n]; inf if never."""
    rays = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (z - camera.camera_to_world[2, 3]) / rays[:, 2]
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)


def upright_depth(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Depth [n], m, of pixels (x, y) [n, 2] in the upright plane that faces the camera, through the nearest pixel on the table.

    If the camera looks down, depth on the table.
    """
    below, axis = camera_depth(camera, pixels, 0.0), camera.camera_to_world[:2, 2]
    along = camera.rays(pixels)[:, :2] @ axis
    if np.hypot(*axis) <= LEVEL_VIEW or along.min() <= 0:
        return below
    return np.asarray((below * along).min() / along)


def beneath_hands(labels: np.ndarray, reach: float) -> np.ndarray:
    """The object [H, W] bool including parts beneath hands: hand pixels between object pixels.

    A hand pixel counts if it is in the morphological closing of the object by a disc of radius `reach`, pixels.
    """
    radius = max(round(reach), 1)
    padded = np.pad((labels == OBJECT).astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(radius))[radius:-radius, radius:-radius] > 0
    return np.asarray((labels == OBJECT) | (closed & (labels >= HANDS)))


def inflated(mask: np.ndarray, depth: np.ndarray, widest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth of front and back [H, W], m, of the ellipsoids over the `discs` of a silhouette `mask` [H, W]; zero outside.

    The disc at q with radius r is the outline of an ellipsoid with center depth `depth` [n] and thickness `widest` [n], m. At
    pixel p, its surfaces are at

        depth_q -+ widest_q / 2 sqrt(1 - |p - q|^2 / r^2)

    The front is the nearest of all, the back the farthest. In pointed corners that no disc covers, the thickness follows the
    distance from the edge, about the middle of the nearest covered pixel.
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
