"""Captures of color alone: one calibrated camera without depth, the table known. The object in frame 0 is its silhouette, lying on
the table; hands and silhouettes of later frames are evidence in the image.

With up as +z, the pixel p shows the object's upper side at height t(p), where its ray meets the plane z = t(p):

    sheets   (`flat`, such as cloth)         t = SHEET_THICKNESS; nodes lie at t / 2
    ropes    (`round`), bodies (all others)  t of the nearest of the ellipsoids below, and their lower side is that of the farthest

Each of the largest discs inside the silhouette (shape.discs), with center q and radius r, pixels, is an ellipsoid that is
w = 2 k r z / f thick, k = 1 for ropes and BODY_THICKNESS for bodies: thickness follows the outline's width, symmetric about the
medial surface on which the centers lie. f is the focal length, z the depth of the center. Where it lies on the table its center is
at half its thickness above it:

    z = h / (d(q) + k r / f)

h is the height of the camera and d(q) how far the ray of q sinks per meter of depth. What stands would be laid far behind itself
so. Therefore no center is farther from the camera than the upright plane

    a(q) <= min a + FOOTPRINT (max s - min s)

a is the distance along the table in the direction in which the camera looks, s that across, on the plane through the nearest
center. What would be beyond the plane rises in it, above what touches the table. `pose` of the capture says lying (no such plane)
or standing (STANDING_FOOTPRINT): one picture cannot say which.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np

from neuspring.config.perception import ColorSettings, Perception
from neuspring.core.artifacts import ImageObservations
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest
from neuspring.data.camera import Camera
from neuspring.data.capture import CAPTURE, CONTROLLERS, HANDS, NOTHING, OBJECT, Capture
from neuspring.data.results import LiftedTracks, Masks, PixelTracks, ShapePrior
from neuspring.intake.points import InSpace, held, read
from neuspring.perception.color_hands import follow_hands, grips, place
from neuspring.perception.controllers import ALWAYS
from neuspring.perception.shape import discs, inflated, no_prior, shape_prior

HAND_BAND = 30.0
"""Distance from the object within which points beside it were drawn, pixels."""
BENEATH = 0.03
"""Part of the object that a hand hides in frame 0: its pixels between pixels of the object, up to this far from them, m."""
GRIP_REACH = 0.02
"""Distance from the object up to which pixels of a hand hold it in frame 0, m at the object."""
GRIP_LENGTH = 0.04
"""Distance from a hand's tip, its pixel farthest along the arm, up to which its pixels hold a sheet, m at the object."""
HANDS_APART = 0.04
"""Distance between the grips of different hands, m at the object."""
HAND_RADIUS = 0.08
"""Corners of a hand are followed this far around its grip, m at the object."""
OUTLINE_POINTS = 300
"""Points of the object's silhouette per frame."""
DISTANCE_CELL = 4
"""Side of the cells of the distance from object and hands, pixels."""
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
HIDDEN_STRIDE = 3
"""Stride among the object's pixels beneath hands: each third gets a point."""


SeenHands: TypeAlias = tuple[dict[str, np.ndarray], list[np.ndarray], dict[str, float]]
"""Entries of ImageObservations about hands, the pixels of each grip, and facts."""


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
    def of(cls, capture: Capture, labels: np.ndarray, settings: ColorSettings) -> FirstFrame:
        """From the labels [H, W] of frame 0. Raises InputError without an object in view of the table."""
        camera = next(iter(capture.cameras.values()))
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
        filled = beneath_hands(labels, BENEATH / size)
        up = capture.description.up_sign
        if kind == "flat":
            heights = np.where(filled, SHEET_THICKNESS, 0.0)
            return cls(camera, up, kind, filled, heights, np.zeros_like(heights), size, {})
        if kind == "round":
            # Where the silhouette is wider than a rope it shows two turns, or a shadow.
            depth, thick, facts = medial(camera, up, filled, 1.0, np.inf, ROPE_WIDEST)
        else:
            bounds = {None: FOOTPRINT, "lying": np.inf, "standing": STANDING_FOOTPRINT}
            depth, thick, facts = medial(camera, up, filled, BODY_THICKNESS, bounds[capture.description.pose])
        y, x = np.nonzero(filled)
        pixels, heights, lower = np.stack([x, y], axis=1).astype(float), np.zeros(filled.shape), np.zeros(filled.shape)
        for side, found in zip((heights, lower), inflated(filled, depth, thick), strict=True):
            # The table cuts off what would be below it.
            side[y, x] = np.maximum(up * camera.lift(pixels, found[y, x])[:, 2], 0.0)
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
        y, x = np.nonzero(self.filled)
        depth = np.zeros(self.filled.shape)
        depth[y, x] = camera_depth(self.camera, np.stack([x, y], axis=1), self.up * self._between(share)[y, x])
        return depth


def medial(
    camera: Camera, up: float, filled: np.ndarray, factor: float, footprint: float, widest: float = np.inf
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Depth [n] and thickness [n], m, of the ellipsoids of the `discs` of a silhouette `filled` [H, W], and `FirstFrame.facts`.

    `factor` is k and FOOTPRINT that of the head of this file; up is +1 or -1. No ellipsoid is thicker than `widest` times the
    median one.
    """
    centers, radii, _ = discs(filled)
    rays = camera.lift(centers.astype(float), np.ones(len(centers))) - camera.camera_to_world[:3, 3]
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
    return np.asarray((labels == OBJECT) | (closed & (labels >= HANDS)))


def lift_color(
    capture: Capture, labels: np.ndarray, tracks: PixelTracks, first: FirstFrame, controllers: int, space: InSpace
) -> tuple[LiftedTracks, ImageObservations]:
    """Tracks and hands in the world as far as they are known, and the evidence in the image.

    labels [T, H, W] are masks. The object's points are known in frame 0; beneath hands some are added that no track has. Hands are
    those that the capture brings (`space`), or at most so many `controllers` of what is seen. Raises InputError without tracks on
    the object, or without a hand.
    """
    camera, name, frames = first.camera, first.camera.name, capture.frame_count
    where = f"{capture.folder}, perception"
    start = np.round(tracks.pixels[0]).astype(int)
    own = labels[0][start[:, 1], start[:, 0]] == OBJECT
    if not own.any():
        raise InputError(where, "at least one tracked point must lie on the object in frame 0", "none", "Look at masks and tracks.")
    y, x = np.nonzero(first.filled & (labels[0] != OBJECT))
    hidden = np.stack([x, y], axis=1)[::HIDDEN_STRIDE].astype(np.float32)
    pixels = np.concatenate([tracks.pixels[:, own], np.repeat(hidden[None], frames, axis=0)], axis=1)
    visible = np.concatenate([tracks.visible[:, own], np.zeros((frames, len(hidden)), bool)], axis=1)
    # Nothing of the object is handed on from future frames.
    visible[capture.train_end :] = False
    pixels = np.where(visible[..., None], pixels, 0.0)
    places = np.concatenate([tracks.pixels[0, own], hidden])
    points = np.zeros((frames, len(places), 3))
    points[0] = first.points(places)
    known = np.zeros((frames, len(places)), bool)
    known[0] = True
    unseen: SeenHands = no_seen_hands(frames), [], {}
    seen, chosen, facts = _seen_hands(capture, labels, first, controllers, where) if space.hands is None else unseen
    image = ImageObservations(
        width=camera.width,
        height=camera.height,
        intrinsics=camera.intrinsics,
        camera_to_world=camera.camera_to_world,
        pixel_size=first.pixel_size,
        pixels=pixels,
        visible=visible,
        **silhouettes(labels[: capture.train_end]),
        cell=DISTANCE_CELL,
        **seen,
        marked=capture.points(name),
    )
    if space.hands is None:
        hands = place(image, np.concatenate([first.fingers(grip) for grip in chosen]))
    else:
        hands = held(space.hands, space.tracks, capture.train_end)
    y, x = np.nonzero(first.filled)
    cloud_pixels = np.stack([x, y], axis=1)
    colors = capture.color(name, 0) / 255.0
    place_rows, pose = np.round(places).astype(int), capture.description.pose
    facts |= {
        "object_tracks": float(own.sum()),
        "hidden_points": float(len(hidden)),
        "visible_share": float(visible[: capture.train_end].mean()),
        "controllers": float(hands.shape[1]),
        "pixel_size_mm": 1e3 * first.pixel_size,
        "highest_mm": 1e3 * float(first.heights.max()),
        **{f"shape_{name}": value for name, value in first.facts.items()},
    }
    lifted = LiftedTracks(
        object_points=points,
        object_visibility=known,
        object_motion_valid=np.zeros_like(known),
        object_colors=colors[place_rows[:, 1], place_rows[:, 0]],
        controller_points=hands,
        controller_valid=ALWAYS if space.hands is None else space.hands.holds,
        cloud=first.points(cloud_pixels),
        cloud_colors=colors[y, x],
        backend=", ".join(["color alone", first.kind, *([pose] if pose and first.kind == "body" else [])]),
        facts=facts,
    )
    return lifted, image


def _seen_hands(capture: Capture, labels: np.ndarray, first: FirstFrame, controllers: int, where: str) -> SeenHands:
    """Evidence of the hands in the masks. Raises InputError for none."""
    # A hand above a sheet hides more of it than its fingers hold.
    sizes = (GRIP_REACH, HANDS_APART, GRIP_LENGTH if first.kind == "flat" else np.inf)
    if not (found := grips(labels[0], first.filled, *(size / first.pixel_size for size in sizes))):
        remedy = f"Mark the hands in frame 0, or bring them in space ({CONTROLLERS[0]})."
        raise InputError(f"{where}, masks of frame 0", "at least one hand must be in view", "none", remedy)
    motion = follow_hands(capture, first.camera.name, labels, found, HAND_RADIUS / first.pixel_size)
    chosen = [grip[farthest(grip.astype(float), max(controllers // len(found), 4))] for grip in found]
    hand_of = np.concatenate([np.full(len(grip), hand) for hand, grip in enumerate(chosen)])
    seen = {"hand_of": hand_of, "hand_centers": motion.centers, "hand_angles": motion.angles, "hand_sizes": motion.sizes}
    facts = {
        "hands": float(len(found)),
        "hand_lost_frames": float(motion.lost),
        "smallest_hand": float(motion.sizes.min()),
        "largest_hand": float(motion.sizes.max()),
    }
    return seen, chosen, facts


def no_seen_hands(frames: int) -> dict[str, np.ndarray]:
    """Entries of ImageObservations about hands that the capture brings: none."""
    flat = np.zeros((frames, 0), np.float32)
    return {"hand_of": np.zeros(0, int), "hand_centers": flat[..., None].repeat(2, 2), "hand_angles": flat, "hand_sizes": flat}


def silhouettes(labels: np.ndarray, samples: int = OUTLINE_POINTS) -> dict[str, np.ndarray]:
    """`inside` and `outside` of ImageObservations from labels [E, H, W]."""
    frames, height, width = labels.shape
    rng = np.random.default_rng(0)
    count, cell = samples, DISTANCE_CELL
    inside = np.full((frames, count, 2), np.nan, np.float32)
    outside = np.zeros((frames, -(-height // cell), -(-width // cell)), np.float32)
    for frame, label in enumerate(labels):
        if not (label == OBJECT).any():
            # Out of view: nothing says where it is.
            continue
        away = cv2.distanceTransform((label == NOTHING).astype(np.uint8), cv2.DIST_L2, 5)
        padded = np.pad(away, ((0, -height % cell), (0, -width % cell)), mode="edge")
        outside[frame] = padded.reshape(outside.shape[1], cell, outside.shape[2], cell).mean(axis=(1, 3))
        from_object = cv2.distanceTransform((label != OBJECT).astype(np.uint8), cv2.DIST_L2, 5)
        y, x = np.nonzero(label == OBJECT)
        rows = rng.choice(len(x), min(count, len(x)), replace=False)
        inside[frame, : len(rows)] = np.stack([x[rows], y[rows]], axis=1)
        # As many points were once drawn beside the object too; without that draw the samples of later frames would be others.
        near = int(((label == NOTHING) & (from_object <= HAND_BAND)).sum())
        rng.choice(near, min(count, near), replace=False)
    return {"inside": inside, "outside": outside}


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
    """Results as `lift` and `shape_prior` make them of captures with depth, and the evidence of the image.

    The prior of ropes and bodies is what lies between their supposed upper and lower side (`FirstFrame`), or a mesh that is placed
    on the upper side. Sheets have none. Raises InputError without object, hands or tracks.
    """
    name = next(iter(capture.cameras))
    labels = masks[name].labels
    first = FirstFrame.of(capture, labels[0], settings.color)
    lifted, image = lift_color(capture, labels, tracks[name], first, settings.lift.controllers, read(capture))
    supposed = Supposed(capture.folder, capture.description, first.depths(1.0))
    whole = replace(masks[name], labels=np.where(first.filled, OBJECT, labels[0])[None].astype(np.uint8))
    shape = settings.shape
    if first.kind == "flat" and shape.backend == "auto":
        return lifted, no_prior(), image
    # Between its upper and its lower side all belongs to the object.
    prior = shape_prior(supposed, {name: whole}, lifted.cloud, replace(shape, back="none"), first.depths(0.0))
    return lifted, replace(prior, backend=f"{prior.backend}, {lifted.backend}"), image
