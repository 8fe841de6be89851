"""The backends of segmentation and tracking: `SEGMENTERS` and `TRACKERS` declare them, and stages and workflow ask them.

To add a backend: its module with the function `segment` or `track`, and its line here; its settings, if it has some, in
neuspring/config/perception.py. A package adds one, a `Backend`, by an entry point of the group `neuspring.segmenters` or
`neuspring.trackers`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config.perception import Perception
from neuspring.core.errors import InputError
from neuspring.registry import Registry

if TYPE_CHECKING:
    import numpy as np

    from neuspring.data.capture import Capture
    from neuspring.perception.track_opencv import Followed


PERCEPTION_SEED = 0
"""Seed of the pixels that are followed and of the points that are sampled; methods have seeds of their own."""


@dataclass(frozen=True, kw_only=True)
class Backend:
    """One way to do a step. Its module is imported when it is used."""

    module: str
    section: str = ""
    """Settings of a segmentation: a field of `perception.segment`; empty: it has none. A tracker is given `perception.track`."""
    gpu: bool = False
    """True where it takes a GPU where there is one; it is then given the device as its last argument."""
    truth: bool = False
    """True where it reads the truth of a synthetic scene: for measuring perception; no method may use it."""

    given: bool = False
    """True where a capture must have something for it that not every one has, which its `require(capture)` asks for."""

    def require(self, folder: Path) -> None:
        """Raise InputError where a capture lacks what it needs, before any job runs. Damaged ones fail their own jobs."""
        from neuspring.data.capture import Capture

        if not self.given:
            return
        try:
            capture = Capture.load(folder)
        except InputError:
            return
        import_module(self.module).require(capture)

    def segment(self, capture: Capture, camera: str, settings: Perception, device: str) -> np.ndarray:
        """Labels [T, H, W] uint8 of one camera: 0 table, 1 object, 2 hands, 3 person (`data.capture.OBJECT`, ...)."""
        own = (getattr(settings.segment, self.section),) if self.section else ()
        labels: np.ndarray = self._call("segment", (capture, camera, *own), device)
        return labels

    def track(self, capture: Capture, camera: str, labels: np.ndarray, settings: Perception, device: str) -> Followed:
        """Tracks of pixels of the masks `labels` [T, H, W]."""
        tracks: Followed = self._call("track", (capture, camera, labels, settings.track, PERCEPTION_SEED), device)
        return tracks

    def _call(self, step: str, given: tuple[Any, ...], device: str) -> Any:
        from neuspring.core.device import resolve_device

        return getattr(import_module(self.module), step)(*given, *((resolve_device(device),) if self.gpu else ()))


SEGMENTERS = Registry(
    "segmenters",
    {
        "given": Backend(module="neuspring.perception.segment_given", given=True),
        "opencv": Backend(module="neuspring.perception.segment_opencv", section="opencv", given=True),
        "marks": Backend(module="neuspring.perception.marks.store", section="marks", given=True),
        "grounded_sam2": Backend(module="neuspring.perception.segment_sam2", section="grounded_sam2", gpu=True),
    },
    Backend,
)
TRACKERS = Registry(
    "trackers",
    {
        "opencv": Backend(module="neuspring.perception.track_opencv"),
        "cotracker3": Backend(module="neuspring.perception.track_cotracker", gpu=True),
        "truth": Backend(module="neuspring.perception.truth", truth=True),
    },
    Backend,
)
BACKENDS = {"segment": SEGMENTERS, "track": TRACKERS}


def segmentation(name: str, capture: Capture) -> str:
    """The backend of a capture's segmentation where `name` is configured: marks, where it has some, in place of `opencv`.

    Whoever has drawn marks knows that height and color do not tell the object from the table.
    """
    from neuspring.perception.marks.marks import MARKS

    return "marks" if name == "opencv" and (capture.folder / MARKS).exists() else name


def require_known(settings: Perception) -> None:
    """Raise InputError, with the names that there are, where a configured backend is none of them."""
    for step, name in (("segment", settings.segment.backend), ("track", settings.track.backend)):
        if name not in BACKENDS[step]:
            raise InputError(f"perception.{step}.backend", f"must be one of {', '.join(BACKENDS[step])}", name)


def _possible(step: str, name: str) -> list[Backend]:
    """Backends that may run where `name` is configured."""
    return [BACKENDS[step][one] for one in ((name, "marks") if (step, name) == ("segment", "opencv") else (name,))]


def segmentation_keys(name: str) -> tuple[str, ...]:
    """Keys of the configuration that a segmentation reads."""
    sections = [one.section for one in _possible("segment", name) if one.section]
    return ("perception.segment.backend", *(f"perception.segment.{section}" for section in sections))


def backend_modules(step: str, name: str) -> tuple[str, ...]:
    """Modules that a backend is made of."""
    return tuple(one.module for one in _possible(step, name))
