"""Carried masks and followed points on real color film, against what was drawn by hand."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from neuspring.config.perception import PointTracking
from neuspring.data.capture import HANDS, OBJECT
from neuspring.data.frames import overlap
from neuspring.perception import track_opencv

RIM = 3.0
"""How far beside its mask a point may lie, pixels: points were marked at tips and corners."""


@dataclass(frozen=True, eq=False)
class Points:
    """tracks/CASE.json: points that were marked by hand."""

    names: list[str]
    frames: list[int]
    xy: np.ndarray
    """[K, F, 2], NaN where hidden."""
    sure: np.ndarray
    """[K, F] bool: marked to 1 to 3 pixels here and in frame 0; the others were guessed, under a fingertip for instance."""

    @classmethod
    def load(cls, path: Path) -> Points:
        values = json.loads(path.read_text())
        own = values["points"].values()
        xy = np.array([[place or (np.nan, np.nan) for place in point["xy"]] for point in own], float)
        uncertain = np.array([point["uncertain"] for point in own])
        return cls(list(values["points"]), values["frames"], xy, ~(uncertain | uncertain[:, :1]) & np.isfinite(xy[..., 0]))


def truths(folder: Path, case: str) -> dict[int, np.ndarray]:
    """Drawn masks by frame."""
    return {int(file.stem): cv2.imread(str(file), 0) for file in sorted((folder / "masks" / case).glob("*.png"))}


@dataclass(frozen=True, eq=False)
class Film:
    """Colors in memory; stands in for a capture where trackers read images."""

    colors: list[np.ndarray]

    @property
    def frame_count(self) -> int:
        return len(self.colors)

    @property
    def cameras(self) -> dict[str, SimpleNamespace]:
        height, width = self.colors[0].shape[:2]
        return {"0": SimpleNamespace(width=width, height=height)}

    def has(self, camera: str, frame: int) -> bool:
        return True

    def color(self, camera: str, frame: int) -> np.ndarray:
        return self.colors[frame]


def overlaps(labels: np.ndarray, truth: dict[int, np.ndarray]) -> np.ndarray:
    """IoU of object and hands [F, 2] in the drawn frames."""
    return np.array([[overlap(labels[k] == label, mask == label) for label in (OBJECT, HANDS)] for k, mask in truth.items()])


def stepwise(colors: list[np.ndarray], labels: np.ndarray, start: np.ndarray, **settings: Any) -> tuple[np.ndarray, np.ndarray]:
    """The tracker of the workflow: places [T, K, 2] and whether they are visible [T, K], among its own random points."""
    chosen = replace(PointTracking(rim=RIM), **settings)
    points = np.concatenate([start, track_opencv.choose(labels[0])]).astype(np.float32)
    found = track_opencv.follow(Film(colors), "0", labels, points, chosen)  # type: ignore[arg-type]
    return found.pixels[:, : len(start)], found.visible[:, : len(start)]


@dataclass(frozen=True)
class Errors:
    """Of the points that are marked in later frames."""

    shown: int
    """Places that were marked and are sure."""
    lost: float
    """Share of them without a place."""
    median: float
    """Pixels, of the others."""
    most: float
    """90th percentile, pixels."""
    hidden: str
    """Of the places where a point is hidden, how many the tracker shows."""

    @classmethod
    def of(cls, points: Points, places: np.ndarray, visible: np.ndarray) -> Errors:
        at = points.frames[1:]
        place, seen = places[at].transpose(1, 0, 2), visible[at].T
        sure, away = points.sure[:, 1:], np.isnan(points.xy[:, 1:, 0])
        errors = np.linalg.norm(place - points.xy[:, 1:], axis=2)[sure & seen]
        median, most = np.percentile(errors, [50, 90]) if len(errors) else (np.nan, np.nan)
        lost = 1 - (sure & seen).sum() / max(sure.sum(), 1)
        return cls(int(sure.sum()), float(lost), float(median), float(most), f"{(away & seen).sum()} of {away.sum()}")
