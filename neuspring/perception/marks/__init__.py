"""Masks from a few marks.

marks     the file marks.json: boxes, clicks, scribbles, polygons
carry     marks on a few frames -> labels and doubt of every frame
store     mask/ of a capture
"""

from neuspring.perception.marks.carry import Carried, Images, carry, frame_mask
from neuspring.perception.marks.marks import MARKS, Mark, Marks

__all__ = ["MARKS", "Carried", "Images", "Mark", "Marks", "carry", "frame_mask"]
