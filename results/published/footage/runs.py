"""The sides of the comparison in `make`: footage with drawn masks, PhysTwin's published prediction, and runs of the workflow."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from neuspring.config.images import Images
from neuspring.config.parse import parse, read_yaml
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import StageRecord, digest_file
from neuspring.core.run_folder import RunFolder
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.perception.marks.marks import Marks
from neuspring.scores.pictures import Scored, iou
from neuspring.splats.draw import picture
from neuspring.stages.render import posed
from results.published.footage.film import MARKS, Points, truths

PHYSTWIN = "PhysTwin (published)"
STILL = "frame 0 repeated"
LEFT_OUT = ("single_push_rope_4",)
"""Cases that take no part in means: PhysTwin's silhouette as read back is too fat there."""
PREFIX = "footage_"
"""Scenarios of the workflow are named after cases, with this before."""
MOST, STEP = 6.0, 0.5
"""Largest shift that is tried, and its step, px."""
METHODS = Path(__file__).parents[3] / "config" / "methods.yaml"


def shifted(image: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """An image [H, W] or [H, W, C], uint8 or bool, moved by (x, y), px; zeros come in.

    Between pixels it is linear. Of a silhouette, pixels stay that are covered by more than a half.
    """
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(image.astype(np.float32), matrix, image.shape[1::-1], flags=cv2.INTER_LINEAR)
    return moved > 0.5 if image.dtype == bool else np.round(moved).astype(np.uint8)


def fitted_shift(silhouette: np.ndarray, labels: np.ndarray, most: float = MOST, step: float = STEP) -> tuple[float, float]:
    """The shift (x, y), px, of a silhouette [H, W] bool with the best IoU with the object of labels [H, W]."""
    tried = np.arange(-most, most + step / 2, step)
    # The smallest of several that are equally good.
    ordered = sorted(((float(x), float(y)) for x in tried for y in tried), key=lambda s: (abs(s[0]) + abs(s[1]), s))
    return max(ordered, key=lambda shift: iou_without_hands(shifted(silhouette, shift), labels))


def iou_without_hands(silhouette: np.ndarray, labels: np.ndarray) -> float:
    """IoU of a silhouette [H, W] bool with the object of labels [H, W]; pixels of hands count on neither side."""
    return iou(silhouette & (labels != HANDS), labels == OBJECT)


@dataclass(frozen=True, eq=False)
class Published:
    """PhysTwin's prediction of a case, as read back from its video."""

    bits: np.ndarray
    """[T, H W / 8] packed bits."""
    rights: list[np.ndarray]
    """Right halves of the video, RGB [H, W, 3] uint8: the prediction over a whitened frame."""
    shift: tuple[float, float]
    """By which it is moved, (x, y), px."""

    @classmethod
    def load(cls, folder: Path, case: str, labels: np.ndarray) -> Published | None:
        """Read back and shifted to the object of frame 0's labels [H, W]; None where there is no rendering."""
        result, video = folder / "result" / f"{case}.npz", folder / "videos" / f"combine_rendering__{case}.mp4"
        if not result.is_file() or not video.is_file():
            return None
        with np.load(result, allow_pickle=False) as stored:
            if "render" not in stored:
                return None
            bits = stored["render"]
        rights, film = [], cv2.VideoCapture(str(video))
        while (read := film.read())[0]:
            rights.append(np.ascontiguousarray(read[1][:, read[1].shape[1] // 2 :, ::-1]))
        plain = cls(bits, rights, (0.0, 0.0))
        return cls(bits, rights, fitted_shift(plain.silhouette(0), labels))

    @property
    def frame_count(self) -> int:
        return min(len(self.bits), len(self.rights))

    def silhouette(self, frame: int) -> np.ndarray:
        """[H, W] bool, moved."""
        return shifted(self._drawn(frame), self.shift)

    def picture(self, frame: int) -> np.ndarray:
        """RGBA [H, W, 4] uint8 over black, moved."""
        cut = shifted(np.where(self._drawn(frame)[..., None], self.rights[frame], 0).astype(np.uint8), self.shift)
        covered = self.silhouette(frame)
        return np.dstack([np.where(covered[..., None], cut, 0), np.where(covered, 255, 0)]).astype(np.uint8)

    def _drawn(self, frame: int) -> np.ndarray:
        height, width = self.rights[frame].shape[:2]
        return np.unpackbits(self.bits[frame])[: height * width].reshape(height, width).astype(bool)


@dataclass(frozen=True, eq=False)
class Case:
    """A case of the footage and its capture."""

    name: str
    folder: Path
    """The folder of the footage."""
    capture: Capture

    @property
    def camera(self) -> str:
        return next(iter(self.capture.cameras))

    @functools.cached_property
    def drawn(self) -> dict[int, np.ndarray]:
        """Labels [H, W] that were drawn, by frame; none of most cases."""
        return truths(self.folder, self.name)

    @functools.cached_property
    def labeled(self) -> dict[int, np.ndarray]:
        """Labels [H, W] of four frames: drawn ones, or, where none were drawn, the capture's, carried from marks."""
        last = self.capture.frame_count - 1
        return self.drawn or {frame: self.labels(frame) for frame in (0, last // 3, 2 * last // 3, last)}

    @functools.cached_property
    def points(self) -> Points | None:
        """Points marked by hand."""
        path = self.folder / "tracks" / f"{self.name}.json"
        return Points.load(path) if path.is_file() else None

    @functools.cached_property
    def published(self) -> Published | None:
        """PhysTwin's prediction, moved to frame 0's drawn mask, or to the capture's where none was drawn."""
        return Published.load(self.folder, self.name, self.drawn.get(0, self.labels(0)))

    def labels(self, frame: int) -> np.ndarray:
        """The capture's labels [H, W]."""
        return self.capture.mask(self.camera, frame)

    def color(self, frame: int) -> np.ndarray:
        return self.capture.color(self.camera, frame)

    @property
    def tasks(self) -> dict[str, range]:
        """Frames that a task averages over."""
        end = self.capture.train_end
        return {"reconstruction": range(1, end), "future": range(end, self.capture.frame_count)}


@dataclass(frozen=True, eq=False)
class Run:
    """A run of the workflow: RESULTS/<scenario>/<method>/<seed>."""

    folder: Path

    @property
    def method(self) -> str:
        return self.folder.parent.name

    @property
    def seed(self) -> int:
        return int(self.folder.name)

    @property
    def scenario(self) -> Path:
        return self.folder.parents[1]

    @functools.cached_property
    def record(self) -> RunRecord:
        return RunRecord.load(self.folder / RUN_RECORD)

    @property
    def key(self) -> str:
        """Changes with the run's results."""
        return f"{self.record.run_key[:16]}-{digest_file(self.folder / RUN_RECORD)[:8]}"

    def stage(self, name: str, role: str) -> Path | None:
        """A file that the record of a stage beside run.json names."""
        path = self.folder / f"{name}.json"
        record = StageRecord.load(path) if path.is_file() else None
        return record.file(role, path) if record and role in record.files else None

    @functools.cached_property
    def observations(self) -> Observations:
        return Observations.load(self.scenario / "observations.npz")

    def positions(self) -> np.ndarray | None:
        """Nodes in every frame [T, N, 3], m; the last one again and again after a divergence. None: there is no trajectory."""
        file = self.stage("rollout", "trajectory")
        trajectory = Trajectory.load(file) if file else None
        if trajectory is None or not len(trajectory.positions):
            return None
        found = trajectory.positions
        return np.concatenate([found, np.repeat(found[-1:], trajectory.frame_count - len(found), axis=0)])

    def pictures(self, capture: Capture, frames: Collection[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """(frame, RGBA [H, W, 4] over black, silhouette [H, W]) of some frames, as the render stage draws its first view.

        Nothing where the run has no splats or no trajectory. After a divergence its last frame stands for the others.
        """
        run = RunFolder.of(self.folder)
        if not {"appearance", "render"} <= set(run.stages) or run.trajectory is None or not frames:
            return
        images = parse(Images, run.records["render"].settings["images"], str(run.stages["render"].path))
        scored = Scored.of(capture, {}, images, "cpu")
        name, last = next(iter(scored.views)), None
        try:
            _, moved = posed(run.stages["appearance"], run.stages["rollout"], run.trajectory, images, "cpu")
            for frame in range(max(frames) + 1):
                last = next(moved, last)
                if frame in frames and last is not None:
                    rgba = picture(last, scored.views[name], scored.backend)
                    yield frame, rgba, rgba[..., 3] >= scored.covered
        except NumericalFailure:
            return


def corrected() -> list[str]:
    """Cases whose committed marks are not of frame 0 alone."""
    paths = sorted((MARKS / "phystwin_camera0").glob("*.json"))
    return [path.stem for path in paths if any(mark.frame for mark in Marks.load(path).of("0"))]


def runs_of(results: Path, case: str, methods: Collection[str] | None = None) -> list[Run]:
    """The finished runs of a case, in the order of methods.yaml, or of `methods`."""
    order = list(methods or (read_yaml(METHODS) if METHODS.is_file() else ()))
    found = []
    for scenario in (f"{PREFIX}{case}", case):
        for path in (results / scenario).glob(f"*/*/{RUN_RECORD}"):
            run = Run(path.parent)
            if run.folder.name.isdigit() and (methods is None or run.method in methods):
                found.append(run)
    return sorted(found, key=lambda run: (order.index(run.method) if run.method in order else len(order), run.method, run.seed))


def cases_of(folder: Path, captures: Path, chosen: Collection[str] | None = None) -> list[Case]:
    """Cases with a capture, all by default. Raises InputError for a chosen one without."""
    names = sorted(path.parent.name for path in captures.glob(f"*/{CAPTURE}")) if chosen is None else list(chosen)
    cases = []
    for name in names:
        capture = Capture.load(captures / name)
        if not capture.description.masks:
            raise InputError(captures / name / CAPTURE, "a capture with masks is required", "masks: false")
        cases.append(Case(name, folder, capture))
    return cases
