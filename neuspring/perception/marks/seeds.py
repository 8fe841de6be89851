"""Marks of one frame as pixels: which are certain, and where a label can be at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT
from neuspring.perception.marks.marks import Mark

UNKNOWN = 255
"""In `Seeds.certain`: no mark says what the pixel is."""
FAR = 0.08
"""Distance from its marks, as part of the image, by which the odds of a label without bounds fall by e."""
STEEP = 0.3
"""Distance from the border of a polygon, as part of its `radius`, by which the log odds change by 1."""
MOST = 4.0
"""Largest log odds by place."""


@dataclass(frozen=True, eq=False)
class Seeds:
    """What the marks of one frame say."""

    certain: np.ndarray
    """[H, W] uint8: the label, or UNKNOWN."""
    possible: np.ndarray
    """[3, H, W] bool: where nothing, object and hands can be."""
    prior: np.ndarray
    """[3, H, W] float32: log odds that the marks' places alone give; 0 where they say nothing."""

    @classmethod
    def of(cls, marks: Sequence[Mark], size: tuple[int, int], scale: float, *, carried: bool = False) -> Seeds:
        """Of the marks on one frame, drawn into an image of `size` (height, width) that is `scale` times the camera's.

        Boxes and polygons bound a label, unless it is also clicked or scribbled outside of them. Hands lie over objects, what is
        ignored over both, and clicks and scribbles over polygons. With `carried` the place of labels is also known from the frame
        before: then a label without marks can be anywhere.
        """
        certain, possible = np.full(size, UNKNOWN, np.uint8), np.ones((3, *size), bool)
        prior = np.zeros((3, *size), np.float32)
        for label in (OBJECT, HANDS):
            own = [mark for mark in marks if mark.value == label]
            areas = [_drawn(mark, size, scale, grown=1) for mark in own if mark.kind in ("box", "polygon")]
            lines = [_drawn(mark, size, scale) for mark in own if mark.kind in ("click", "scribble")]
            if not own:
                possible[label] = carried
            elif areas and all((line & np.any(areas, axis=0)).any() for line in lines):
                possible[label] = np.any([*areas, *lines], axis=0)
            elif not carried:
                # Not bounded: what is far from all marks of a label needs a color that says so.
                far = cv2.distanceTransform((~np.any([*areas, *lines], axis=0)).astype(np.uint8), cv2.DIST_L2, 5)
                prior[label] = np.maximum(-far / (FAR * max(size)), -MOST)
            for mark in own:
                if mark.kind == "polygon":
                    inside = _drawn(mark, size, scale, grown=0)
                    away = [cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) for part in (inside, ~inside)]
                    slope = (away[0] - away[1]) / max(STEEP * mark.radius * scale, 0.5)
                    prior[label] = np.maximum(prior[label], np.clip(slope, -MOST, MOST) * (possible[label]))
        for kinds in (("polygon", "box"), ("scribble", "click")):
            for mark in sorted(marks, key=lambda mark: (OBJECT, HANDS, NOTHING).index(mark.value)):
                # A box of a label says where it can be, not where it is.
                if mark.kind in kinds and (mark.kind != "box" or mark.label == "ignore"):
                    certain[_drawn(mark, size, scale)] = mark.value
        known = certain != UNKNOWN
        possible[:, known] = False
        for label in (NOTHING, OBJECT, HANDS):
            possible[label, certain == label] = True
        return cls(certain, possible, prior)

    @property
    def marked(self) -> np.ndarray:
        """Where something is certain or inside of a polygon [H, W] bool."""
        return np.asarray((self.certain != UNKNOWN) | (self.prior[1:] > 0).any(axis=0))

    def part(self, window: tuple[slice, slice]) -> Seeds:
        """A window of it."""
        return Seeds(self.certain[window], self.possible[(slice(None), *window)], self.prior[(slice(None), *window)])


def _drawn(mark: Mark, size: tuple[int, int], scale: float, *, grown: int = -1) -> np.ndarray:
    """The pixels [H, W] bool that a mark covers: a polygon without its uncertain border (-1), as it is (0), or grown by it (1)."""
    image: np.ndarray = np.zeros(size, np.uint8)
    # Pixel centers lie at whole coordinates, so the image begins at -0.5.
    points = (np.array(mark.points) + 0.5) * scale - 0.5
    radius = max(mark.radius * scale, 0.5)
    if mark.kind == "box":
        (x0, y0), (x1, y1) = np.round(np.sort(points, axis=0)).astype(int).tolist()
        image[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1] = 1
        return image.astype(bool)
    whole = np.round(points).astype(np.int32)[:, None]
    if mark.kind == "polygon":
        cv2.fillPoly(image, [whole], 1)
        if mark.label != "ignore" and grown:
            ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius) + 1,) * 2)
            # Outside of the image the polygon goes on: a hand is not uncertain where the image ends.
            eroded = cv2.erode(image, ellipse, borderType=cv2.BORDER_REPLICATE)
            image = np.asarray(cv2.dilate(image, ellipse) if grown > 0 else eroded)
        return image.astype(bool)
    cv2.polylines(image, [whole], False, 1, max(round(2 * radius), 1))
    for x, y in whole[:, 0].tolist():
        cv2.circle(image, (x, y), max(round(radius), 0), 1, -1)
    return image.astype(bool)
