"""Pieces of automatic masks, judged over the whole video: sleeves, clutter that never moves, and which of several is the object."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from neuspring.config.perception import OpenCvSegmentation
from neuspring.data.capture import HANDS, NOTHING, OBJECT, Capture

SAMPLED = 24
"""Frames from which it is learned which pixels change."""
CHANGES = 24
"""Range of gray over the video from which a pixel changes."""
MOVING = 0.1
"""Part of a piece's pixels that change, from which it moves."""
CONTACT = 5
"""Distance, pixels, within which things touch."""
BREAK = 0.03
"""Step of depth, m, that divides pieces which touch in the image alone."""
BORDER_RUN = 4
"""Pixels at the image's border from which a piece reaches it."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A connected piece of the object's mask in one frame."""

    mask: np.ndarray
    area: int
    moving: float
    """Part of its pixels that change during the video."""
    at_border: bool
    at_hand: bool
    hand_distance: float
    """Pixels to the nearest hand; infinite without one."""


def sort_pieces(capture: Capture, camera: str, labels: np.ndarray, settings: OpenCvSegmentation) -> np.ndarray:
    """Labels [T, H, W] in which sleeves are hands, clutter is nothing and one object is left, as far as settings ask for it."""
    if not settings.sleeves and settings.clutter == "keep" and settings.object == "all":
        return labels
    result, changes = labels.copy(), changing(capture, camera)
    chosen: np.ndarray | None = None
    for frame in range(len(labels)):
        if not capture.has(camera, frame):
            continue
        own = pieces_of(labels[frame], capture.depth(camera, frame), changes)
        if settings.sleeves:
            sleeves = [piece for piece in own if piece.at_border and piece.at_hand and piece.moving > MOVING]
            for piece in sleeves:
                result[frame][piece.mask] = HANDS
            own = [piece for piece in own if piece not in sleeves]
        if settings.clutter == "drop":
            still = [piece for piece in own if piece.moving < MOVING and not piece.at_hand]
            for piece in still:
                result[frame][piece.mask] = NOTHING
            own = [piece for piece in own if piece not in still]
        if settings.object != "all" and own:
            chosen = _choose(own, chosen, settings.object, f"{capture.folder}, camera {camera}, frame {frame}")
            result[frame][(result[frame] == OBJECT) & ~chosen] = NOTHING
    return result


def changing(capture: Capture, camera: str) -> np.ndarray:
    """Which pixels [H, W] bool change during the video: their range of gray, a little blurred."""
    frames = [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]
    grays = []
    for index in np.unique(np.linspace(0, len(frames) - 1, SAMPLED).astype(int)):
        gray = cv2.cvtColor(np.ascontiguousarray(capture.color(camera, frames[index])), cv2.COLOR_RGB2GRAY)
        grays.append(cv2.GaussianBlur(gray, (0, 0), 1.0))
    return np.asarray(np.ptp(np.stack(grays), axis=0) > CHANGES)


def pieces_of(labels: np.ndarray, depth: np.ndarray, changes: np.ndarray) -> list[Piece]:
    """Connected pieces of the object [H, W], divided where the depth [H, W], m, has a step."""
    own = labels == OBJECT
    if not own.any():
        return []
    kernel = np.ones((3, 3), np.uint8)
    # Unknown depth divides nothing.
    far = cv2.dilate(np.where(depth > 0, depth, 0.0).astype(np.float32), kernel)
    near = cv2.erode(np.where(depth > 0, depth, 100.0).astype(np.float32), kernel)
    whole = own & ~(far - near > BREAK)
    count, numbers = cv2.connectedComponents(whole.astype(np.uint8), connectivity=4)
    if count == 1:
        whole = own
        count, numbers = cv2.connectedComponents(whole.astype(np.uint8), connectivity=4)
    rows, columns = distance_transform_edt(~whole, return_distances=False, return_indices=True)
    numbers = np.where(own, numbers[rows, columns], 0)
    hands = labels == HANDS
    away = cv2.distanceTransform((~hands).astype(np.uint8), cv2.DIST_L2, 5) if hands.any() else np.full(labels.shape, np.inf)
    pieces = []
    for number in range(1, count):
        mask = numbers == number
        area = int(mask.sum())
        rim = int(mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum())
        distance = float(away[mask].min())
        pieces.append(Piece(mask, area, float(changes[mask].mean()), rim >= BORDER_RUN, distance <= CONTACT, distance))
    return pieces


def _choose(pieces: list[Piece], before: np.ndarray | None, rule: str, where: str) -> np.ndarray:
    """The mask [H, W] bool of the object: what overlaps with the one before, else what the rule says."""
    if before is not None:
        reach = cv2.dilate(before.astype(np.uint8), np.ones((2 * CONTACT + 1,) * 2, np.uint8)).astype(bool)
        kept = [piece.mask for piece in pieces if (piece.mask & reach).sum() > 0.1 * piece.area]
        return np.any(kept, axis=0) if kept else before
    scores = {
        "largest": [float(piece.area) for piece in pieces],
        "moving": [piece.moving * piece.area for piece in pieces],
        "nearest_hand": [-piece.hand_distance + 1e-6 * piece.area for piece in pieces],
    }[rule]
    best = pieces[int(np.argmax(scores))]
    if len(pieces) > 1:
        y, x = (round(float(values.mean())) for values in np.nonzero(best.mask))
        others = ", ".join(f"{piece.area}" for piece in pieces if piece is not best)
        print(
            f"{where}: {len(pieces)} pieces; taken ({rule}): {best.area} pixels around ({x}, {y}); left: {others} pixels",
            flush=True,
        )
    return best.mask
