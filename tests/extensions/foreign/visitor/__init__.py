"""One minimal member of each kind. Modules that compute are imported where they are used."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.baselines import Baseline
from neuspring.extensions.exports import Export
from neuspring.extensions.make_capture.formats import CaptureFormat
from neuspring.extensions.make_capture.streams import Series
from neuspring.report.blocks import Text
from neuspring.report.data import ReportSection


def write_xyz(source: Any, frames: Sequence[int], output: Path) -> list[Path]:
    """Nodes of the first frame as lines x y z, m."""
    path = output.with_suffix(".xyz")
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, source.positions[frames[0]])
    return [path]


def lag(model: None, observations: Any, splats: np.ndarray | None, device: str) -> Any:
    """The body goes with the mean of the hands."""
    from neuspring.baselines.results import Prediction
    from neuspring.core.artifacts import Trajectory

    moved = observations.controller_points.mean(axis=1) - observations.controller_points[0].mean(axis=0)
    positions = (observations.nodes[None] + moved[:, None]).astype(np.float32)
    return Prediction(Trajectory(positions=positions, frame_count=observations.scenario.frame_count))


@dataclass(frozen=True)
class Stack:
    """Pictures in one file .npz, under the name `color` or `depth`."""

    path: Path
    kind: str

    @property
    def series(self) -> Series:
        """Numbers from 0."""
        return Series(list(range(len(self._pictures()))))

    def _pictures(self) -> np.ndarray:
        with np.load(self.path) as arrays:
            return np.asarray(arrays[self.kind])

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W]."""
        return iter(self._pictures()[list(places)])

    def files(self, places: Sequence[int]) -> list[Path]:
        """One for all."""
        return [self.path] * len(places)


LAG = Baseline(prediction="visitor:lag")
STACK = CaptureFormat(about="a .npz file with {kind}", recognizes=lambda path: path.suffix == ".npz", pictures=Stack)
XYZ = Export(write=write_xyz, frames="0")
VISIT = ReportSection(order=99, title="A visit", make=lambda material: [Text(text="A visitor was here.")])
