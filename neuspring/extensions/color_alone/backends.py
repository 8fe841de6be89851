"""Backends of perception that the entry points name; nothing heavy is imported."""

from neuspring.perception.backends import Backend

SEGMENTER = Backend(module="neuspring.extensions.color_alone.segment", file="marks.json")
LIFTER = Backend(module="neuspring.extensions.color_alone.lift")
