"""Transfers of twins to clips of cables, without the twins: the files that the stage leaves, and the observations of the clips."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring.core.artifacts import Observations
from neuspring.core.files import write_table
from neuspring.core.records import StageRecord, digest_file
from neuspring.scores.metrics import SCORE_COLUMNS
from tests.support import scenarios

FRAMES, RATE, MARKERS = 9, 100.0, 7
HELD = (0, 1, MARKERS - 2, MARKERS - 1)


def swinging(name: str, cable: str) -> Observations:
    """A hanging cable of 7 markers that turns about the vertical; the controllers hold two at either end."""
    along, time = np.linspace(0, 1, MARKERS), np.arange(FRAMES) / RATE
    shape = np.stack([along - 0.5, 0 * along, 0.8 - 0.6 * np.sin(np.pi * along)], axis=1)
    c, s = np.cos(3 * time), np.sin(3 * time)
    turns = np.moveaxis(np.array([[c, -s, 0 * c], [s, c, 0 * c], [0 * c, 0 * c, 1 + 0 * c]]), -1, 0)
    markers = np.einsum("tij,vj->tvi", turns, shape)
    free = markers[:, 2:-2]
    about = {"name": name, "category": cable, "source": "mocap", "frame_rate": RATE, "ground": False}
    order = np.array([5, 6, 0, 1, 2, 7, 8])
    return scenarios.seen(free, markers[:, HELD], about, surface_points=shape[2:4] + 0.01, tracks=free, line=order)


def write_transfer(
    results: Path, cable: str, method: str, seed: int, l1: Mapping[str, float], *, diverged: tuple[str, ...] = ()
) -> Path:
    """A transfer from `<cable>_train` with the error l1, m, on each clip, three times that of free markers; returns its record."""
    source, courses = f"{cable}_train", []
    record = results / source / method / str(seed) / "transfer.json"
    record.parent.mkdir(parents=True, exist_ok=True)
    identity = {"category": cable, "method": method, "seed": seed, "task": "transfer", "unit": "m", "frames": FRAMES - 1}
    rows = []
    for clip, value in l1.items():
        seen = swinging(clip, cable)
        seen.save(results / clip / "observations.npz")
        errors = {"deform_l1": value, "track_error": 3 * value}
        rows += [identity | {"scenario": clip, "metric": name, "value": error} for name, error in errors.items()]
        frames = np.arange(FRAMES)
        course = {"scenario": clip, "frame": frames, "seconds": frames / RATE}
        courses += [pd.DataFrame(course | {"metric": name, "value": error * (frames > 0)}) for name, error in errors.items()]
    endings = {"scores": ".parquet", "frames": "_frames.parquet"}
    paths = {role: record.with_name(f"transfer{suffix}") for role, suffix in endings.items()}
    write_table(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)), paths["scores"])
    write_table(pd.concat(courses), paths["frames"])
    files = {role: [path.name, digest_file(path)] for role, path in paths.items()}
    facts = {"diverged": list(diverged), "targets": len(l1) + len(diverged)}
    StageRecord(stage="transfer", status="ok", files=files, facts=facts).save(record)
    return record
