"""Quality numbers of the masks of one camera."""

from __future__ import annotations

import numpy as np

from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.plausible.pieces import objects


def mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Shares and counts of labels [T, H, W]; what makes a result worse is also printed."""
    present = [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]
    empty = [frame for frame in present if not (labels[frame] == OBJECT).any()]
    count = objects(labels[0])
    if count > 1:
        print(
            f"camera {camera}: the object's mask of frame 0 has {count} pieces far apart; two objects become one twin", flush=True
        )
    if empty:
        print(
            f"camera {camera}: no object in {len(empty)} frames, first in frame {empty[0]}; its points are invisible there",
            flush=True,
        )
    return {
        "object_share": float((labels == OBJECT).mean()),
        "hand_share": float((labels == HANDS).mean()),
        "objects": float(count),
        "frames_without_object": float(len(empty)),
        "frames_missing": float(len(labels) - len(present)),
    }
