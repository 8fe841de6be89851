"""Lifter for one color camera without depth: the object in frame 0 from its silhouette (`first_frame`) or from nodes of the
capture (`given`), and image evidence of hands, tracks and silhouettes in later frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from neuspring.config.perception import Perception
from neuspring.core.artifacts import ImageObservations
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest
from neuspring.data.camera import Camera
from neuspring.data.capture import CONTROLLERS, NOTHING, OBJECT, Capture
from neuspring.data.results import LiftedTracks, Masks, PixelTracks
from neuspring.extensions.color_alone.checks import findings_of
from neuspring.extensions.color_alone.first_frame import FirstFrame
from neuspring.extensions.color_alone.given import GivenFrame
from neuspring.extensions.color_alone.hands import follow_hands, grips, hands_strip, place
from neuspring.extensions.color_alone.pixels import away_from, pixels_of
from neuspring.intake.points import InSpace, held, read
from neuspring.perception.backends import Lifted
from neuspring.perception.controllers import ALWAYS, MOST_CONTROLLERS
from neuspring.perception.shape import no_prior, shape_prior

GRIP_REACH = 0.02
"""Largest distance of grasping hand pixels from the object in frame 0, m at the object."""
GRIP_LENGTH = 0.04
"""Largest distance of hand pixels that grasp a sheet from the hand's tip, its pixel farthest along the arm, m at the object."""
HANDS_APART = 0.04
"""Smallest distance between grasps of different hands, m at the object."""
HAND_RADIUS = 0.08
"""Radius around a grasp in which corners of the hand are tracked, m at the object."""
OUTLINE_POINTS = 300
"""Number of points of the object's silhouette per frame."""
DISTANCE_CELL = 4
"""Cell size of the distance map of object and hands, pixels."""
HIDDEN_STRIDE = 3
"""Every third object pixel beneath hands gets a point."""
SeenHands = tuple[dict[str, np.ndarray], list[np.ndarray], dict[str, float]]
"""Entries of ImageObservations about hands, the pixels of each grasp, and facts."""


def lift(capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception) -> Lifted:
    """Lift object and hands; returns points in the world, the shape prior and the image evidence.

    Nodes of the capture replace an assumed shape and the prior. Otherwise, the prior of ropes and bodies is the volume between
    their assumed upper and lower side (`FirstFrame`), or a mesh aligned with the upper side. Sheets have no prior. Raises
    InputError without object, hands or tracks.
    """
    name, space = next(iter(capture.cameras)), read(capture)
    labels = masks[name].labels
    given = len(space.nodes)
    first = GivenFrame.by(capture, labels[0], space.nodes) if given else FirstFrame.of(capture, labels[0])
    lifted, image = lift_color(capture, labels, tracks[name], first, space)
    prior, shape = no_prior(), settings.shape
    if not given and not (first.kind == "flat" and shape.backend == "auto"):
        assumed = Supposed(capture.folder, capture.description, first.depths(1.0))
        filled = replace(masks[name], labels=np.where(first.filled, OBJECT, labels[0])[None].astype(np.uint8))
        # The full volume between the upper and the lower side belongs to the object.
        prior = shape_prior(assumed, {name: filled}, lifted.cloud, replace(shape, back="none"), first.depths(0.0))
        prior = replace(prior, backend=f"{prior.backend}, {lifted.backend}")
    return Lifted(
        tracks=lifted,
        prior=prior,
        findings=findings_of(lifted, prior, capture.description.up_sign, image),
        image=image,
        depths={name: depth_of(first.camera, lifted.cloud)},
        pictures={"hands": hands_strip(capture, image, lifted.controller_points)},
    )


def depth_of(camera: Camera, cloud: np.ndarray) -> np.ndarray:
    """Depth [H, W], m, of a cloud [P, 3], m; 0 at other pixels."""
    pixels, distance = camera.project(cloud.astype(float))
    seen = camera.sees(pixels)
    x, y = np.round(pixels[seen]).astype(int).T
    depth = np.zeros((camera.height, camera.width))
    depth[y, x] = distance[seen]
    return depth


@dataclass(frozen=True, eq=False)
class Supposed(Capture):
    """A capture with the depth of the assumed shape in frame 0."""

    front: np.ndarray
    """[H, W], m."""

    def depth(self, camera: str, frame: int) -> np.ndarray:
        """Depth [H, W], m."""
        return self.front if frame == 0 else super().depth(camera, frame)


def lift_color(
    capture: Capture, labels: np.ndarray, tracks: PixelTracks, first: FirstFrame, space: InSpace
) -> tuple[LiftedTracks, ImageObservations]:
    """Tracks and controllers in the world, and the image evidence; labels [T, H, W] are masks.

    World points of the object are known only in frame 0. Object pixels beneath hands get points without tracks. Controllers are
    those of the capture (`space`), or at most MOST_CONTROLLERS visible hand points. Raises InputError without tracks on the
    object, or without a hand.
    """
    camera, name, frames = first.camera, first.camera.name, capture.frame_count
    where = f"{capture.folder}, perception"
    start = np.round(tracks.pixels[0]).astype(int)
    tracked = labels[0][start[:, 1], start[:, 0]] == OBJECT
    if not tracked.any():
        raise InputError(where, "at least one tracked point must be on the object in frame 0", "none", "Check masks and tracks.")
    hidden = pixels_of(first.filled & (labels[0] != OBJECT))[::HIDDEN_STRIDE].astype(np.float32)
    pixels = np.concatenate([tracks.pixels[:, tracked], np.repeat(hidden[None], frames, axis=0)], axis=1)
    visible = np.concatenate([tracks.visible[:, tracked], np.zeros((frames, len(hidden)), bool)], axis=1)
    # Drops tracks of future frames, and of repeated images, whose annotated points are not scored either.
    new = np.array([capture.shows(name, frame) for frame in range(frames)])
    visible[~new] = visible[capture.train_end :] = False
    pixels = np.where(visible[..., None], pixels, 0.0)
    origins = np.concatenate([tracks.pixels[0, tracked], hidden])
    points = np.zeros((frames, len(origins), 3))
    points[0] = first.points(origins)
    known = np.zeros((frames, len(origins)), bool)
    known[0] = True
    unseen: SeenHands = no_seen_hands(frames), [], {}
    seen, chosen, facts = _seen_hands(capture, labels, first, where) if space.hands is None else unseen
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
        marked=np.where(new[:, None, None], capture.points(name), np.nan),
    )
    if space.hands is None:
        hands = place(image, np.concatenate([first.fingers(grip) for grip in chosen]), ground=capture.description.ground)
    else:
        hands = held(space.hands, space.tracks, capture.train_end)
    colors = capture.color(name, 0) / 255.0
    rounded, pose = np.round(origins).astype(int), capture.description.pose
    facts |= {
        "object_tracks": float(tracked.sum()),
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
        object_colors=colors[rounded[:, 1], rounded[:, 0]],
        controller_points=hands,
        controller_valid=ALWAYS if space.hands is None else space.hands.holds,
        cloud=first.points(pixels_of(first.filled)),
        cloud_colors=colors[first.filled],
        backend=", ".join(["color alone", first.kind, *([pose] if pose and first.kind == "body" else [])]),
        facts=facts,
    )
    return lifted, image


def _seen_hands(capture: Capture, labels: np.ndarray, first: FirstFrame, where: str) -> SeenHands:
    """Image evidence of the hands in the masks. Raises InputError without a hand."""
    # A hand above a sheet hides more of it than its fingers grasp.
    sizes = (GRIP_REACH, HANDS_APART, GRIP_LENGTH if first.kind == "flat" and capture.description.ground else np.inf)
    if not (grasps := grips(labels[0], first.filled, *(size / first.pixel_size for size in sizes))):
        remedy = f"Annotate the hands in frame 0, or add them in 3D ({CONTROLLERS[0]})."
        raise InputError(f"{where}, masks of frame 0", "at least one hand must be in view", "none", remedy)
    motion = follow_hands(capture, first.camera.name, labels, grasps, HAND_RADIUS / first.pixel_size)
    chosen = [grip[farthest(grip.astype(float), max(MOST_CONTROLLERS // len(grasps), 4))] for grip in grasps]
    hand_of = np.concatenate([np.full(len(grip), hand) for hand, grip in enumerate(chosen)])
    seen = {"hand_of": hand_of, "hand_centers": motion.centers, "hand_angles": motion.angles, "hand_sizes": motion.sizes}
    facts = {
        "hands": float(len(grasps)),
        "hand_lost_frames": float(motion.lost),
        "smallest_hand": float(motion.sizes.min()),
        "largest_hand": float(motion.sizes.max()),
    }
    return seen, chosen, facts


def no_seen_hands(frames: int) -> dict[str, np.ndarray]:
    """Empty entries of ImageObservations about hands, for controllers of the capture."""
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
            # The object is out of view: no evidence.
            continue
        padded = np.pad(away_from(label != NOTHING), ((0, -height % cell), (0, -width % cell)), mode="edge")
        outside[frame] = padded.reshape(outside.shape[1], cell, outside.shape[2], cell).mean(axis=(1, 3))
        shown = pixels_of(label == OBJECT)
        rows = rng.choice(len(shown), min(count, len(shown)), replace=False)
        inside[frame, : len(rows)] = shown[rows]
    return {"inside": inside, "outside": outside}
