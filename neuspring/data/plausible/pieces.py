"""How many objects a mask shows."""

from __future__ import annotations

import cv2
import numpy as np

from neuspring.data.capture import OBJECT

APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""


def objects(labels: np.ndarray) -> int:
    """Number of objects with label 1: pieces of the mask that stay apart when it is grown by half of APART."""
    own = (labels == OBJECT).astype(np.uint8)
    reach = max(int(0.5 * APART * max(labels.shape)), 1)
    grown = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
    count, pieces = cv2.connectedComponents(grown)
    sizes = np.array([(own[pieces == k] > 0).sum() for k in range(1, count)])
    return int((sizes >= SECOND * sizes.max()).sum()) if len(sizes) else 0
