"""Results of runs without the runs: records, scores and stand-ins for the files that stages leave."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.records import StageRecord, canonical, digest_file
from neuspring.scores.metrics import COLUMNS, UNITS

Scores = Mapping[tuple[str, str], float]
"""By task and metric, in our units."""


def write_run(
    results: Path,
    scenario: str,
    method: str,
    seed: int,
    scores: Scores,
    *,
    frames: int = 10,
    category: str = "rope",
    source: str = "phystwin",
    status: str = "ok",
    reason: str = "",
    images: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    held: Scores | None = None,
) -> Path:
    """A finished (or failed) run as `stages.score` leaves it; returns the path of run.json.

    `held`: of a failed run, the scores of a prediction that stays at its last finite frame.
    """
    folder = results / scenario / method / str(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in {"scores": scores, "held": held}.items():
        rows = [(scenario, category, method, seed, *key, value, UNITS[key[1]], frames) for key, value in (values or {}).items()]
        if values is not None:
            pd.DataFrame(rows, columns=list(COLUMNS)).to_parquet(folder / f"{name}.parquet")
    (folder / "twin.npz").write_bytes(f"{scenario} {method} {seed}".encode())
    observations = results / scenario / "observations.npz"
    observations.write_bytes(scenario.encode())
    own = {"fit": {"epochs": 7, "horizon": 1}, "kind": "springs", "seed": seed} | dict(settings or {})
    twin = ["twin.npz", digest_file(folder / "twin.npz")]
    StageRecord(stage="fit", status="ok", files={"twin": twin}, settings=own).save(folder / "fit.json")
    content = {
        "scenario": scenario,
        "method": method,
        "variant": {},
        "seed": seed,
        "status": status,
        "reason": reason,
        "notes": [],
        "settings": {"fit": own},
        "data_digest": digest_file(observations),
    }
    made = {"fit": twin[1], "scores": digest_file(folder / "scores.parquet")}
    run = content | {
        "images": images,
        "format": 1,
        "run_key": hashlib.sha256(canonical([content, made]).encode()).hexdigest(),
        "source": source,
        "category": category,
        "commit": "0123456789abcdef",
        "device": "cpu",
        "machine": "x86_64, Python 3.11",
        "started": "2026-11-21T10:00:00+00:00",
        "ended": "2026-11-21T10:05:00+00:00",
        "timings": {},
        "params": {},
        "scores_file": "scores.parquet",
        "held_file": None if held is None else "held.parquet",
        "artifacts": {"records": ["fit.json"]},
    }
    (folder / "run.json").write_text(json.dumps(run))
    return folder / "run.json"


def all_scores(factor: float = 1.0) -> dict[tuple[str, str], float]:
    """Every metric of both tasks; `factor` scales the errors, and what is better when higher falls with it."""
    one = {"chamfer": 0.01 * factor, "track_error": 0.02 * factor, "psnr": 30 / factor, "ssim": 0.9 / factor}
    one |= {"lpips": 0.05 * factor, "iou": 0.8 / factor}
    return {(task, metric): value for task in ("reconstruction", "future") for metric, value in one.items()}


def write_benchmark(
    results: Path, scenarios: Iterable[str], methods: Mapping[str, float], seeds: Iterable[int] = (0, 1), **kept: Any
) -> None:
    """Runs of every scenario, method and seed; `methods` maps each to the factor of its errors, which scenarios and seeds vary."""
    rng = np.random.default_rng(0)
    for scenario in scenarios:
        size = rng.uniform(0.5, 1.5)
        for seed in seeds:
            for method, factor in methods.items():
                write_run(results, scenario, method, seed, all_scores(size * factor * rng.uniform(0.99, 1.01)), **kept)
