"""Entries of synthetic scenes in the registries of sources and trackers."""

from __future__ import annotations

from neuspring.perception.backends import Backend
from neuspring.scenes.sources import Source

SYNTHETIC = Source(
    module="neuspring.extensions.synthetic.make",
    reads=("synthetic",),
    films=True,
    write_capture="neuspring.extensions.synthetic.make",
    needs_data=False,
    has_truth=True,
    cameras=lambda folder, config: ("0", "1", "2"),
)
TRUTH = Backend(module="neuspring.extensions.synthetic.exact", truth=True)
"""Exact tracks, and the true surface."""
