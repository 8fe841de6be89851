"""Errors of hands that were seen in color alone, where they are given in space too: part of `make`.

A hand's grip is the mean of its controllers; the given one is the mean of its points that are near the object in frame 0. Seen
hands move in a plane (neuspring/perception/color_hands.py).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from neuspring.checks.observed import GRIP
from neuspring.core.artifacts import Observations
from neuspring.core.table import Table
from neuspring.data.capture import CAPTURE, Capture
from neuspring.intake.points import read
from results.published.footage.runs import PREFIX

FEWEST = 3
"""Given points of a grip, where fewer are within GRIP of the object."""
MM = 1e3
COLUMNS = ("scenario", "hand", "frame", "task", "off", "way")


def grips(centers: np.ndarray, given: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Given grips [T, H, 3], m, of hands whose grips in frame 0 are `centers` [H, 3], from given points [T, C, 3] and nodes [N, 3].

    A point belongs to the nearest hand. Raises ValueError where a hand has none.
    """
    away, owner = cKDTree(nodes).query(given[0])[0], cKDTree(centers).query(given[0])[1]
    found = []
    for hand in range(len(centers)):
        own = np.flatnonzero(owner == hand)
        if not len(own):
            raise ValueError(f"hand {hand}: no given point is nearest to it")
        ranked = own[np.argsort(away[own], kind="stable")]
        found.append(given[:, ranked[: max(FEWEST, int((away[own] <= GRIP).sum()))]].mean(axis=1))
    return np.stack(found, axis=1)


def hand_errors(seen: Observations, given: np.ndarray, nodes: np.ndarray) -> Iterable[tuple[int, int, float, float]]:
    """(hand, frame, off, way), mm: distance of a grip from the given one, and of its way since frame 0 from the given way."""
    assert seen.image is not None
    points, owner = seen.controller_points.astype(float), seen.image.hand_of
    own = np.stack([points[:, owner == hand].mean(axis=1) for hand in range(seen.image.hands)], axis=1)
    step = own - grips(own[0], given[: len(own)].astype(float), nodes)
    for hand in range(own.shape[1]):
        for frame in range(len(own)):
            off, way = (float(MM * np.linalg.norm(one)) for one in (step[frame, hand], step[frame, hand] - step[0, hand]))
            yield hand, frame, off, way


def hand_rows(captures: Path, scenarios: Iterable[Path]) -> pd.DataFrame:
    """Tidy rows of all scenarios whose hands were seen in color alone and are given as CAPTURES/CASE_points."""
    rows = []
    for scenario in scenarios:
        points = captures / f"{scenario.name.removeprefix(PREFIX)}_points"
        seen = Observations.load(scenario / "observations.npz")
        if not (points / CAPTURE).is_file() or seen.image is None or not seen.image.hands:
            continue
        space = read(Capture.load(points))
        assert space.hands is not None
        for hand, frame, off, way in hand_errors(seen, space.hands.points, space.nodes):
            task = "future" if frame >= seen.scenario.train_end else "training"
            rows.append((scenario.name, hand, frame, task, off, way))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def hand_lines(rows: pd.DataFrame) -> list[str]:
    """The table, by scenario and hand."""
    if not len(rows):
        return []
    lines = []
    for (scenario, hand), own in rows.groupby(["scenario", "hand"], sort=False):
        last = own["frame"] == own["frame"].max()
        parts = [own["task"].eq("training") & (own["frame"] > 0), own["task"].eq("future"), last]
        cells = [own.loc[part, column].mean() for column in ("off", "way") for part in parts]
        first = own.loc[own["frame"] == 0, "off"].mean()
        texts = ("–" if np.isnan(value) else f"{value:.0f}" for value in (first, *cells))
        lines.append([str(scenario), str(hand), *texts])
    names = ["training", "future", "last frame"]
    header = [
        "scenario",
        "hand",
        "off, frame 0",
        *(f"off, {n}" for n in names),
        *(f"way, {n}" for n in names),
    ]
    about = ["mm. Off: distance of the grip from the given one. Way: the same of their ways since frame 0: motion alone counts."]
    return ["", "## Hands against given ones", "", *about, "", *Table.of_texts(header, lines).markdown()]
