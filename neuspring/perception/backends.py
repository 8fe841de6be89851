"""The backends of segmentation, tracking and lifting: `SEGMENTERS`, `TRACKERS` and `LIFTERS` declare them.

To add a backend: its module with the function `segment`, `track` or `lift`, and its line here; its settings, if it has some, in
neuspring/config/perception.py. A package adds one, a `Backend`, by an entry point of the group `neuspring.segmenters`,
`neuspring.trackers` or `neuspring.lifters`. The word `depth` of a capture names its lifter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config.perception import Perception
from neuspring.core.errors import InputError
from neuspring.registry import Registry

if TYPE_CHECKING:
    import numpy as np

    from neuspring.core.artifacts import ImageObservations
    from neuspring.core.findings import Finding
    from neuspring.data.capture import Capture
    from neuspring.data.results import LiftedTracks, Masks, PixelTracks, ShapePrior
    from neuspring.perception.film import Carried, Progress
    from neuspring.perception.marks import Mark
    from neuspring.perception.track_opencv import Followed


@dataclass(frozen=True, kw_only=True)
class Lifted:
    """What a lifter knows of object and hands in the world."""

    tracks: LiftedTracks
    prior: ShapePrior
    findings: Sequence[Finding]
    image: ImageObservations | None = None
    """Evidence in the image, for losses that read it."""
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Supposed depth of frame 0 [H, W], m, by camera, in place of a measured one."""
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Images to look at, RGB [H, W, 3], by the names of their files."""


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
    needs: tuple[str, ...] = ()
    """Streams of a capture that it reads besides color, `Capture.streams`."""
    file: str = ""
    """File of a capture that it reads; its module checks the content: `require(capture)`."""

    def require(self, folder: Path) -> None:
        """Raise InputError where a capture lacks what it needs, before any job runs. Damaged ones fail their own jobs."""
        from neuspring.data.capture import Capture

        try:
            capture = Capture.load(folder)
        except InputError:
            return
        self.require_of(capture)

    def require_of(self, capture: Capture) -> None:
        """Raise InputError where a capture lacks a stream or the file that it needs."""
        if lacking := [stream for stream in self.needs if stream not in capture.streams]:
            rule = f"perception.segment.backend needs {', '.join(lacking)} of every frame"
            remedy = f"Draw masks with `neuspring annotate {capture.folder}`, or choose another backend."
            raise InputError(capture.folder, rule, f"a capture of {', '.join(sorted(capture.streams))}", remedy)
        if self.file:
            import_module(self.module).require(capture)

    def segment(self, capture: Capture, camera: str, settings: Perception, device: str) -> np.ndarray:
        """Labels [T, H, W] uint8 of one camera: 0 table, 1 object, 2 hands, 3 person (`data.capture.OBJECT`, ...).

        Raises InputError where the capture lacks what it needs.
        """
        self.require_of(capture)
        labels: np.ndarray = self._call("segment", (capture, camera, *self._settings(settings)), device)
        return labels

    def carry(
        self, capture: Capture, camera: str, marks: Sequence[Mark], settings: Perception, device: str, progress: Progress
    ) -> Carried:
        """Labels and doubt of every frame of a camera from marks on a few. Raises InputError where they do not fit."""
        carried: Carried = self._call("carry", (capture, camera, marks, progress, *self._settings(settings)), device)
        return carried

    def outline(self, capture: Capture, camera: str, frame: int, marks: Sequence[Mark]) -> np.ndarray:
        """Labels [H, W] uint8 of one frame from the marks on it. Raises InputError where no object or hand is marked there."""
        labels: np.ndarray = import_module(self.module).outline(capture, camera, frame, marks)
        return labels

    def track(self, capture: Capture, camera: str, labels: np.ndarray, settings: Perception, device: str) -> Followed:
        """Tracks of pixels of the masks `labels` [T, H, W]."""
        tracks: Followed = self._call("track", (capture, camera, labels, settings.track), device)
        return tracks

    def surface(self, capture: Capture) -> ShapePrior:
        """The surface of frame 0, where the backend knows it."""
        surface: ShapePrior = import_module(self.module).surface(capture)
        return surface

    def lift(self, capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception) -> Lifted:
        """Object and hands in the world, from masks and tracks by camera."""
        lifted: Lifted = import_module(self.module).lift(capture, masks, tracks, settings)
        return lifted

    def _settings(self, settings: Perception) -> tuple[Any, ...]:
        return (getattr(settings.segment, self.section),) if self.section else ()

    def _call(self, step: str, given: tuple[Any, ...], device: str) -> Any:
        from neuspring.core.device import resolve_device

        return getattr(import_module(self.module), step)(*given, *((resolve_device(device),) if self.gpu else ()))


SEGMENTERS = Registry(
    "segmenters",
    {
        "given": Backend(module="neuspring.perception.segment_given", needs=("mask",)),
        "opencv": Backend(module="neuspring.perception.segment_opencv", needs=("depth",)),
        "grounded_sam2": Backend(module="neuspring.perception.segment_sam2", section="grounded_sam2", gpu=True),
    },
    Backend,
)
TRACKERS = Registry(
    "trackers",
    {
        "opencv": Backend(module="neuspring.perception.track_opencv"),
        "cotracker3": Backend(module="neuspring.perception.track_cotracker", gpu=True),
    },
    Backend,
)
LIFTERS = Registry("lifters", {"measured": Backend(module="neuspring.perception.lift")}, Backend)
BACKENDS = {"segment": SEGMENTERS, "track": TRACKERS, "lift": LIFTERS}


def segmentation(name: str, capture: Capture) -> str:
    """The backend of a capture's segmentation where `name` is configured: that of the capture's marks in place of `opencv`.

    A user who has drawn marks knows that height and color do not separate the object from the table.
    """
    drawn = (other for other, one in SEGMENTERS.items() if one.file and (capture.folder / one.file).exists())
    return next(drawn, name) if name == "opencv" else name


def require_known(settings: Perception) -> None:
    """Raise InputError, with the names that there are, where a configured backend is none of them."""
    for step, name in (("segment", settings.segment.backend), ("track", settings.track.backend)):
        if name not in BACKENDS[step]:
            remedy = "Restore the folder of its extension." if name in BACKENDS[step].left_out else ""
            raise InputError(f"perception.{step}.backend", f"must be one of {', '.join(BACKENDS[step])}", name, remedy)


def segmentation_keys(name: str) -> tuple[str, ...]:
    """Keys of the configuration that a segmentation reads."""
    section = SEGMENTERS[name].section
    return ("perception.segment.backend", *((f"perception.segment.{section}",) if section else ()))


def backend_modules(step: str, name: str) -> tuple[str, ...]:
    """Modules that a backend is made of; `opencv` gives way to marks."""
    others = [one.module for one in SEGMENTERS.values() if one.file and (step, name) == ("segment", "opencv")]
    return (BACKENDS[step][name].module, *others)
