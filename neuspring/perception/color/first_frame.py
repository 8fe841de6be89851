"""The object in frame 0 without depth: its silhouette, lying on the table.

With up as +z, the pixel p shows the object's upper side at height t(p), where its ray meets the plane z = t(p):

    sheets   (`flat`, such as cloth)  t = `sheet_thickness`; nodes lie at t / 2
    ropes    (`round`)                t = c(p) s, a round cross-section on the table
    bodies   (all others)             t = `body_thickness` c(p) s

The lower side of ropes and bodies is the table: the silhouette is inflated symmetrically about its middle t / 2, and rests. Nodes
fill it, as single nodes in the middle would fall to the table.

c(p) is the width of the silhouette at p, in pixels, rounded towards its edge (shape_back.round_chord), and s the width of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.config.perception import ColorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Camera, Capture
from neuspring.perception.shape_back import round_chord

ROPE_WIDEST = 1.5
"""Largest thickness of a rope over its median."""


@dataclass(frozen=True)
class FirstFrame:
    """Where the object is in frame 0; up is +1 or -1."""

    camera: Camera
    up: float
    kind: str
    """flat, round or body."""
    filled: np.ndarray
    """[H, W] bool: the object, and what of it lies beneath hands."""
    heights: np.ndarray
    """t [H, W], m; 0 outside."""
    pixel_size: float
    """Width of a pixel at the object, m (median)."""

    @classmethod
    def of(cls, capture: Capture, labels: np.ndarray, settings: ColorSettings) -> FirstFrame:
        """From the labels [H, W] of frame 0. Raises InputError without an object in view of the table."""
        camera = next(iter(capture.cameras.values()))
        up = 1.0 if capture.description.up == "+z" else -1.0
        category = capture.description.category
        kind = "flat" if category in settings.flat else "round" if category in settings.round else "body"
        if not (labels == OBJECT).any():
            raise InputError(f"{capture.folder}, masks of frame 0", "the object must be in view", "none of its pixels")
        y, x = np.nonzero(labels == OBJECT)
        below = camera_depth(camera, np.stack([x, y], axis=1), 0.0)
        if not (np.isfinite(below) & (below > 0)).all():
            rule = "every pixel of the object in frame 0 must look at the table, z = 0"
            remedy = "Check camera_to_world and up: without depth the table is where they say."
            raise InputError(f"{capture.folder / CAPTURE}, camera_to_world", rule, "some look above the horizon", remedy)
        size = float(np.median(below)) / camera.intrinsics[0, 0]
        filled = beneath_hands(labels, settings.beneath / size)
        chord = round_chord(filled) * size
        factor = settings.body_thickness if kind == "body" else 1.0
        heights = np.where(filled, settings.sheet_thickness, 0.0) if kind == "flat" else factor * chord
        if kind == "round":
            # Where the silhouette is wider than a rope it shows two turns, or a shadow.
            heights = np.minimum(heights, ROPE_WIDEST * np.median(heights[filled]))
        return cls(camera, up, kind, filled, heights, size)

    @property
    def front(self) -> np.ndarray:
        """Depth [H, W], m, of the upper side; 0 outside."""
        return self._depths(1.0)

    @property
    def back(self) -> np.ndarray:
        """Depth [H, W], m, of the lower side: the table."""
        return self._depths(0.0)

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, of pixels (x, y) [n, 2]: of a sheet its middle, of others their upper side.

        Pixels outside of the silhouette have the height of its nearest pixel.
        """
        share = 0.5 if self.kind == "flat" else 1.0
        return self.camera.lift(pixels.astype(float), camera_depth(self.camera, pixels, share * self._up(pixels)))

    def fingers(self, pixels: np.ndarray) -> np.ndarray:
        """World points [n, 3], m, where fingers hold the object: a sheet by its upper side, others at half their height.

        There is no point of the object there (`points`): a spring between the two would have no length.
        """
        share = 1.0 if self.kind == "flat" else 0.5
        return self.camera.lift(pixels.astype(float), camera_depth(self.camera, pixels, share * self._up(pixels)))

    def _up(self, pixels: np.ndarray) -> np.ndarray:
        """z of the upper side at pixels [n], m."""
        _, labels = cv2.distanceTransformWithLabels((~self.filled).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        height_of = np.zeros(labels.max() + 1)
        height_of[labels[self.filled]] = self.heights[self.filled]
        x, y = np.round(pixels).astype(int).T
        rows, columns = np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)
        return np.asarray(self.up * height_of[labels[rows, columns]])

    def _depths(self, share: float) -> np.ndarray:
        y, x = np.nonzero(self.filled)
        depth = np.zeros(self.filled.shape)
        depth[y, x] = camera_depth(self.camera, np.stack([x, y], axis=1), share * self.up * self.heights[y, x])
        return depth


def camera_depth(camera: Camera, pixels: np.ndarray, z: np.ndarray | float) -> np.ndarray:
    """Depth [n], m along the optical axis, at which the rays of pixels (x, y) [n, 2] meet the planes at z [n]; inf: never."""
    rays = camera.lift(pixels.astype(float), np.ones(len(pixels))) - camera.camera_to_world[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (z - camera.camera_to_world[2, 3]) / rays[:, 2]
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)


def beneath_hands(labels: np.ndarray, reach: float) -> np.ndarray:
    """The object [H, W] bool with what hands hide of it: their pixels that lie between pixels of the object.

    A hand's pixel lies between them if it is in the object's closing by a disc of radius `reach`, pixels.
    """
    radius = max(round(reach), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    padded = np.pad((labels == OBJECT).astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius] > 0
    return np.asarray((labels == OBJECT) | (closed & (labels == HANDS)))
