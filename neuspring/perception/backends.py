"""The backends of segmentation, tracking and lifting, declared by `SEGMENTERS`, `TRACKERS` and `LIFTERS`.

To add a backend, write a module with the function `segment`, `track` or `lift`, and add its line here. Its settings go to
neuspring/config/perception.py. Another package adds a `Backend` by an entry point of the group `neuspring.segmenters`,
`neuspring.trackers` or `neuspring.lifters`. The key `depth` of a capture names its lifter.
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
    """Result of a lifter: object and controllers in the world."""

    tracks: LiftedTracks
    prior: ShapePrior
    findings: Sequence[Finding]
    image: ImageObservations | None = None
    """Image evidence, for losses in the image plane."""
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Assumed depth of frame 0 [H, W], m, by camera, if none was measured."""
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Figures, RGB [H, W, 3], by file name."""


@dataclass(frozen=True, kw_only=True)
class Backend:
    """One implementation of a step. Its module is imported on first use."""

    module: str
    section: str = ""
    """Field of `perception.segment` with the settings of a segmenter; empty: none. Trackers receive `perception.track`."""
    gpu: bool = False
    """True if it uses a GPU when available; it then receives the device as its last argument."""
    truth: bool = False
    """True if it reads the truth of a synthetic scene, to measure perception; no method may use it."""
    needs: tuple[str, ...] = ()
    """Streams of a capture that it requires besides color, see `Capture.streams`."""
    file: str = ""
    """File of a capture that it requires; `require(capture)` of its module checks the content."""

    def require(self, folder: Path) -> None:
        """Raise InputError if a capture misses an input, before any job runs. A damaged capture passes; its jobs fail."""
        from neuspring.data.capture import Capture

        try:
            capture = Capture.load(folder)
        except InputError:
            return
        self.require_of(capture)

    def require_of(self, capture: Capture) -> None:
        """Raise InputError if a capture misses a required stream or file."""
        if missing := [stream for stream in self.needs if stream not in capture.streams]:
            rule = f"perception.segment.backend requires {', '.join(missing)} in every frame"
            remedy = f"Annotate the capture with `neuspring annotate {capture.folder}`, or choose another backend."
            raise InputError(capture.folder, rule, f"a capture with {', '.join(sorted(capture.streams))}", remedy)
        if self.file:
            import_module(self.module).require(capture)

    def segment(self, capture: Capture, camera: str, settings: Perception, device: str) -> np.ndarray:
        """Labels [T, H, W] uint8 of one camera: 0 nothing, 1 object, 2 hands, 3 person (`data.capture.OBJECT`, ...).

        Raises InputError if the capture misses an input.
        """
        self.require_of(capture)
        labels: np.ndarray = self._call("segment", (capture, camera, *self._settings(settings)), device)
        return labels

    def carry(
        self, capture: Capture, camera: str, marks: Sequence[Mark], settings: Perception, device: str, progress: Progress
    ) -> Carried:
        """Labels and doubt of all frames, from annotations of a few. Raises InputError if they do not fit the capture."""
        carried: Carried = self._call("carry", (capture, camera, marks, progress, *self._settings(settings)), device)
        return carried

    def outline(self, capture: Capture, camera: str, frame: int, marks: Sequence[Mark]) -> np.ndarray:
        """Labels [H, W] uint8 of one frame from its annotations. Raises InputError without an object or a hand among them."""
        labels: np.ndarray = import_module(self.module).outline(capture, camera, frame, marks)
        return labels

    def track(self, capture: Capture, camera: str, labels: np.ndarray, settings: Perception, device: str) -> Followed:
        """Tracks of pixels inside the masks `labels` [T, H, W]."""
        tracks: Followed = self._call("track", (capture, camera, labels, settings.track), device)
        return tracks

    def surface(self, capture: Capture) -> ShapePrior:
        """The true surface of frame 0; only for backends with `truth`."""
        surface: ShapePrior = import_module(self.module).surface(capture)
        return surface

    def lift(self, capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception) -> Lifted:
        """Object and controllers in the world, from masks and tracks by camera."""
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
    """Name of the segmentation backend of a capture: `name`, except that annotations replace `opencv`.

    A user annotates a capture because height and color do not separate the object from the table.
    """
    annotated = (other for other, entry in SEGMENTERS.items() if entry.file and (capture.folder / entry.file).exists())
    return next(annotated, name) if name == "opencv" else name


def require_known(settings: Perception) -> None:
    """Raise InputError, with the known names, if a configured backend is unknown."""
    for step, name in (("segment", settings.segment.backend), ("track", settings.track.backend)):
        if name not in BACKENDS[step]:
            remedy = "Restore the folder of its extension in neuspring/extensions." if name in BACKENDS[step].left_out else ""
            raise InputError(f"perception.{step}.backend", f"must be one of {', '.join(BACKENDS[step])}", name, remedy)


def segmentation_keys(name: str) -> tuple[str, ...]:
    """Configuration keys that a segmentation backend reads."""
    section = SEGMENTERS[name].section
    return ("perception.segment.backend", *((f"perception.segment.{section}",) if section else ()))


def backend_modules(step: str, name: str) -> tuple[str, ...]:
    """Modules of a backend; `opencv` includes those of annotations, which may replace it."""
    others = [entry.module for entry in SEGMENTERS.values() if entry.file and (step, name) == ("segment", "opencv")]
    return (BACKENDS[step][name].module, *others)
