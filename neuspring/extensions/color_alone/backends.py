"""Perception backends of the entry points; imports nothing heavy."""

from neuspring.perception.backends import Backend

SEGMENTER = Backend(module="neuspring.extensions.color_alone.segment", file="marks.json")
LIFTER = Backend(module="neuspring.extensions.color_alone.lift")
