"""One color camera without depth: the object of frame 0 on the table (`first_frame`), or at nodes that the capture brings
(`given`); hands and silhouettes of later frames are evidence in the image."""

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
HIDDEN_STRIDE = 3
"""Stride among the object's pixels beneath hands: each third gets a point."""
SeenHands = tuple[dict[str, np.ndarray], list[np.ndarray], dict[str, float]]
"""Entries of ImageObservations about hands, the pixels of each grip, and facts."""


def lift(capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception) -> Lifted:
    """Object and hands in the world as far as they are known, the shape prior, and the evidence of the image.

    Nodes that the capture brings take the place of a supposed shape, and there is no prior. Else the prior of ropes and bodies is
    what lies between their supposed upper and lower side (`FirstFrame`), or a mesh that is placed on the upper side; sheets have
    none. Raises InputError without object, hands or tracks.
    """
    name, space = next(iter(capture.cameras)), read(capture)
    labels = masks[name].labels
    given = len(space.nodes)
    first = GivenFrame.by(capture, labels[0], space.nodes) if given else FirstFrame.of(capture, labels[0])
    lifted, image = lift_color(capture, labels, tracks[name], first, space)
    prior, shape = no_prior(), settings.shape
    if not given and not (first.kind == "flat" and shape.backend == "auto"):
        supposed = Supposed(capture.folder, capture.description, first.depths(1.0))
        whole = replace(masks[name], labels=np.where(first.filled, OBJECT, labels[0])[None].astype(np.uint8))
        # Between its upper and its lower side all belongs to the object.
        prior = shape_prior(supposed, {name: whole}, lifted.cloud, replace(shape, back="none"), first.depths(0.0))
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
    """Depth [H, W], m, at the pixels of a cloud [P, 3], m; 0 elsewhere."""
    pixels, distance = camera.project(cloud.astype(float))
    seen = camera.sees(pixels)
    x, y = np.round(pixels[seen]).astype(int).T
    depth = np.zeros((camera.height, camera.width))
    depth[y, x] = distance[seen]
    return depth


@dataclass(frozen=True, eq=False)
class Supposed(Capture):
    """A capture whose depth in frame 0 is that of the supposed shape."""

    front: np.ndarray
    """[H, W], m."""

    def depth(self, camera: str, frame: int) -> np.ndarray:
        """Depth [H, W], m."""
        return self.front if frame == 0 else super().depth(camera, frame)


def lift_color(
    capture: Capture, labels: np.ndarray, tracks: PixelTracks, first: FirstFrame, space: InSpace
) -> tuple[LiftedTracks, ImageObservations]:
    """Tracks and hands in the world as far as they are known, and the evidence in the image.

    labels [T, H, W] are masks. The object's points are known in frame 0; beneath hands some are added that no track has. Hands are
    those that the capture brings (`space`), or at most MOST_CONTROLLERS points of what is seen. Raises InputError without tracks on
    the object, or without a hand.
    """
    camera, name, frames = first.camera, first.camera.name, capture.frame_count
    where = f"{capture.folder}, perception"
    start = np.round(tracks.pixels[0]).astype(int)
    own = labels[0][start[:, 1], start[:, 0]] == OBJECT
    if not own.any():
        raise InputError(where, "at least one tracked point must lie on the object in frame 0", "none", "Look at masks and tracks.")
    hidden = pixels_of(first.filled & (labels[0] != OBJECT))[::HIDDEN_STRIDE].astype(np.float32)
    pixels = np.concatenate([tracks.pixels[:, own], np.repeat(hidden[None], frames, axis=0)], axis=1)
    visible = np.concatenate([tracks.visible[:, own], np.zeros((frames, len(hidden)), bool)], axis=1)
    # Nothing of the object is handed on from future frames, or of repeated images, of which marks are not scored either.
    new = np.array([capture.shows(name, frame) for frame in range(frames)])
    visible[~new] = visible[capture.train_end :] = False
    pixels = np.where(visible[..., None], pixels, 0.0)
    places = np.concatenate([tracks.pixels[0, own], hidden])
    points = np.zeros((frames, len(places), 3))
    points[0] = first.points(places)
    known = np.zeros((frames, len(places)), bool)
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
        cloud=first.points(pixels_of(first.filled)),
        cloud_colors=colors[first.filled],
        backend=", ".join(["color alone", first.kind, *([pose] if pose and first.kind == "body" else [])]),
        facts=facts,
    )
    return lifted, image


def _seen_hands(capture: Capture, labels: np.ndarray, first: FirstFrame, where: str) -> SeenHands:
    """Evidence of the hands in the masks. Raises InputError for none."""
    # A hand above a sheet hides more of it than its fingers hold.
    sizes = (GRIP_REACH, HANDS_APART, GRIP_LENGTH if first.kind == "flat" and capture.description.ground else np.inf)
    if not (found := grips(labels[0], first.filled, *(size / first.pixel_size for size in sizes))):
        remedy = f"Mark the hands in frame 0, or bring them in space ({CONTROLLERS[0]})."
        raise InputError(f"{where}, masks of frame 0", "at least one hand must be in view", "none", remedy)
    motion = follow_hands(capture, first.camera.name, labels, found, HAND_RADIUS / first.pixel_size)
    chosen = [grip[farthest(grip.astype(float), max(MOST_CONTROLLERS // len(found), 4))] for grip in found]
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
        padded = np.pad(away_from(label != NOTHING), ((0, -height % cell), (0, -width % cell)), mode="edge")
        outside[frame] = padded.reshape(outside.shape[1], cell, outside.shape[2], cell).mean(axis=(1, 3))
        shown = pixels_of(label == OBJECT)
        rows = rng.choice(len(shown), min(count, len(shown)), replace=False)
        inside[frame, : len(rows)] = shown[rows]
    return {"inside": inside, "outside": outside}
