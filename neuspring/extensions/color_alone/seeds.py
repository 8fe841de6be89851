"""Evidence of the annotations of one frame: certain, possible and probable labels of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT, PERSON
from neuspring.extensions.color_alone.pixels import away_from
from neuspring.perception.marks import FILLED_MARKS, Mark, drawn

UNMARKED_PIXEL = 255
"""Value in `Seeds.certain` of a pixel without annotation."""
ODDS_FALL = 0.08
"""Distance from its annotations at which the odds of an unbounded label fall by e, as a fraction of the image."""
POLYGON_SLOPE = 0.3
"""Distance from the border of a polygon at which the log odds change by 1, as a fraction of its `radius`."""
MOST_ODDS = 4.0
"""Largest log odds by position."""


@dataclass(frozen=True, eq=False)
class Seeds:
    """Evidence of the annotations of one frame."""

    certain: np.ndarray
    """[H, W] uint8: the label, or UNMARKED_PIXEL."""
    possible: np.ndarray
    """[K, H, W] bool: possible pixels of nothing, object and hands; K = 4 with a person."""
    prior: np.ndarray
    """[K, H, W] float32: log odds from the positions of annotations; 0 without evidence."""

    @classmethod
    def of(cls, marks: Sequence[Mark], size: tuple[int, int], scale: float, *, carried: bool = False, kinds: int = PERSON) -> Seeds:
        """Draw the annotations of one frame into an image of `size` (height, width), which is `scale` times the camera's image.

        Boxes and polygons bound a label, unless clicks or scribbles of the label are outside them. Hands override the object,
        ignored areas override both, and clicks and scribbles override polygons. With `carried`, the previous frame also locates
        labels, so that a label without annotations can be anywhere, like a person. `kinds` is K.
        """
        certain, possible = np.full(size, UNMARKED_PIXEL, np.uint8), np.ones((kinds, *size), bool)
        prior = np.zeros((kinds, *size), np.float32)
        for label in (OBJECT, HANDS):
            own = [mark for mark in marks if mark.value == label]
            areas = [drawn(mark, size, scale, grown=1) for mark in own if mark.kind in ("box", "polygon")]
            lines = [drawn(mark, size, scale) for mark in own if mark.kind in ("click", "scribble")]
            if not own:
                possible[label] = carried
            elif areas and all((line & np.any(areas, axis=0)).any() for line in lines):
                possible[label] = np.any([*areas, *lines], axis=0)
            elif not carried:
                # Not bounded: pixels far from all annotations of a label need evidence of color.
                far = away_from(np.any([*areas, *lines], axis=0))
                prior[label] = np.maximum(-far / (ODDS_FALL * max(size)), -MOST_ODDS)
            for mark in own:
                if mark.kind == "polygon":
                    inside = drawn(mark, size, scale, grown=0)
                    slope = (away_from(~inside) - away_from(inside)) / max(POLYGON_SLOPE * mark.radius * scale, 0.5)
                    prior[label] = np.maximum(prior[label], np.clip(slope, -MOST_ODDS, MOST_ODDS) * (possible[label]))
        for shapes in (("polygon", "box"), ("scribble", "click")):
            for mark in sorted(marks, key=lambda mark: (OBJECT, HANDS, PERSON, NOTHING).index(mark.value)):
                # A box gives possible pixels of a label, not certain ones.
                if mark.kind in shapes and (mark.kind != "box" or mark.label in FILLED_MARKS):
                    certain[drawn(mark, size, scale)] = mark.value
        known = certain != UNMARKED_PIXEL
        possible[:, known] = False
        for label in range(kinds):
            possible[label, certain == label] = True
        return cls(certain, possible, prior)

    @property
    def marked(self) -> np.ndarray:
        """Pixels [H, W] bool that are certain or inside a polygon."""
        return np.asarray((self.certain != UNMARKED_PIXEL) | (self.prior[1:] > 0).any(axis=0))

    def part(self, window: tuple[slice, slice]) -> Seeds:
        """The evidence in a window of the image."""
        return Seeds(self.certain[window], self.possible[(slice(None), *window)], self.prior[(slice(None), *window)])
