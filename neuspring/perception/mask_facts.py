"""Quality numbers of the masks of one camera."""

from __future__ import annotations

import numpy as np

from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.plausible.pieces import objects


def mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Shares and counts of labels [T, H, W]; `look` says what they mean."""
    present = [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]
    empty = [frame for frame in present if not (labels[frame] == OBJECT).any()]
    count = objects(labels[0])
    return {
        "object_share": float((labels == OBJECT).mean()),
        "hand_share": float((labels == HANDS).mean()),
        "objects": float(count),
        "frames_without_object": float(len(empty)),
        "frames_missing": float(len(labels) - len(present)),
    }
