"""What losses read of the images: tracked pixels and silhouettes of the training frames, and the motion of hands in all frames."""

from __future__ import annotations

import cv2
import numpy as np

from neuspring.config.perception import ColorSettings
from neuspring.core.artifacts import ImageObservations
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest
from neuspring.data.capture import NOTHING, OBJECT, Capture
from neuspring.perception.color.first_frame import FirstFrame
from neuspring.perception.color.hands import follow_hands, grips
from neuspring.perception.results import LiftedTracks, PixelTracks
from neuspring.twin.hand_paths import depths_of, place

BAND = 30.0
"""How far from the object points beside it were drawn, pixels."""
HIDDEN_STRIDE = 3
"""Of the object's pixels beneath hands each third gets a point."""


def lift_color(
    capture: Capture, labels: np.ndarray, tracks: PixelTracks, first: FirstFrame, settings: ColorSettings, controllers: int
) -> tuple[LiftedTracks, ImageObservations]:
    """Tracks and hands in the world as far as they are known, and the evidence in the image.

    labels [T, H, W] are masks. The object's points are known in frame 0; beneath hands some are added that no track has. Raises
    InputError without tracks on the object, or without a hand.
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
    # A hand above a sheet hides more of it than its fingers hold.
    length = settings.grip_length if first.kind == "flat" else np.inf
    sizes = (settings.grip_reach, settings.hands_apart, length)
    held = grips(labels[0], first.filled, *(size / first.pixel_size for size in sizes))
    if not held:
        raise InputError(f"{where}, masks of frame 0", "at least one hand must be in view", "none", "Mark the hands in frame 0.")
    motion = follow_hands(capture, name, labels, held, settings.hand_radius / first.pixel_size)
    chosen = [grip[farthest(grip.astype(float), max(controllers // len(held), 4))] for grip in held]
    hand_of = np.concatenate([np.full(len(grip), hand) for hand, grip in enumerate(chosen)])
    image = ImageObservations(
        width=camera.width,
        height=camera.height,
        intrinsics=camera.intrinsics,
        camera_to_world=camera.camera_to_world,
        pixel_size=first.pixel_size,
        pixels=pixels,
        visible=visible,
        **silhouettes(labels[: capture.train_end], settings),
        cell=settings.cell,
        hand_of=hand_of,
        hand_centers=motion.centers,
        hand_angles=motion.angles,
        hand_sizes=motion.sizes,
        marked=capture.points(name),
    )
    grip_points = np.concatenate([first.fingers(grip) for grip in chosen])
    guess = depths_of(image, {"hand_tilt": settings.hand_tilt, "hand_size": 0.0}, capture.train_end, first.up)
    y, x = np.nonzero(first.filled)
    cloud_pixels = np.stack([x, y], axis=1)
    colors = capture.color(name, 0) / 255.0
    place_rows = np.round(places).astype(int)
    facts = {
        "object_tracks": float(own.sum()),
        "hidden_points": float(len(hidden)),
        "visible_share": float(visible[: capture.train_end].mean()),
        "controllers": float(len(hand_of)),
        "hands": float(len(held)),
        "hand_lost_frames": float(motion.lost),
        "smallest_hand": float(motion.sizes.min()),
        "largest_hand": float(motion.sizes.max()),
        "pixel_size_mm": 1e3 * first.pixel_size,
        "highest_mm": 1e3 * float(first.heights.max()),
    }
    lifted = LiftedTracks(
        object_points=points,
        object_visibility=known,
        object_motion_valid=np.zeros_like(known),
        object_colors=colors[place_rows[:, 1], place_rows[:, 0]],
        controller_points=place(image, grip_points, guess),
        cloud=first.points(cloud_pixels),
        cloud_colors=colors[y, x],
        backend=f"color alone, {first.kind}",
        facts=facts,
    )
    return lifted, image


def silhouettes(labels: np.ndarray, settings: ColorSettings) -> dict[str, np.ndarray]:
    """`inside` and `outside` of ImageObservations from labels [E, H, W]."""
    frames, height, width = labels.shape
    rng = np.random.default_rng(0)
    count, cell = settings.samples, settings.cell
    inside = np.full((frames, count, 2), np.nan, np.float32)
    outside = np.zeros((frames, -(-height // cell), -(-width // cell)), np.float32)
    for frame, label in enumerate(labels):
        away = cv2.distanceTransform((label == NOTHING).astype(np.uint8), cv2.DIST_L2, 5)
        padded = np.pad(away, ((0, -height % cell), (0, -width % cell)), mode="edge")
        outside[frame] = padded.reshape(outside.shape[1], cell, outside.shape[2], cell).mean(axis=(1, 3))
        from_object = cv2.distanceTransform((label != OBJECT).astype(np.uint8), cv2.DIST_L2, 5)
        if not (label == OBJECT).any():
            # Out of view: nothing says where it is.
            outside[frame] = 0.0
            continue
        y, x = np.nonzero(label == OBJECT)
        rows = rng.choice(len(x), min(count, len(x)), replace=False)
        inside[frame, : len(rows)] = np.stack([x[rows], y[rows]], axis=1)
        # As many points were once drawn beside the object too; without that draw the samples of later frames would be others.
        near = int(((label == NOTHING) & (from_object <= BAND)).sum())
        rng.choice(near, min(count, near), replace=False)
    return {"inside": inside, "outside": outside}
