"""Results of runs without the runs: records, scores and stand-ins for the files that stages leave."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.records import StageRecord, digest_file
from neuspring.core.run_record import key_of
from neuspring.core.table import Cell, Table
from neuspring.report.blocks import Block, Fold
from neuspring.report.study import write_study
from neuspring.report.summary import summary_text
from neuspring.scores.failures import LeftOut
from neuspring.scores.metrics import METRICS, SCORE_COLUMNS
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import Study
from neuspring.scores.runs import Collected, collect
from neuspring.scores.study import StudyNumbers
from tests.support.runs import run_record

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
    frozen: Scores | None = None,
) -> Path:
    """A finished (or failed) run as `stages.score` leaves it; returns the path of run.json.

    `frozen`: of a failed run, the scores of a prediction that stays at its last finite frame.
    """
    folder = results / scenario / method / str(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in {"scores": scores, "held": frozen}.items():
        units = {key: METRICS[key[1]].unit for key in values or {}}
        rows = [(scenario, category, method, seed, *key, value, units[key], frames) for key, value in (values or {}).items()]
        if values is not None:
            pd.DataFrame(rows, columns=list(SCORE_COLUMNS)).to_parquet(folder / f"{name}.parquet")
    (folder / "twin.npz").write_bytes(f"{scenario} {method} {seed}".encode())
    observations = results / scenario / "observations.npz"
    observations.write_bytes(scenario.encode())
    own = {"fit": {"epochs": 7, "horizon": 1}, "kind": "springs", "seed": seed} | dict(settings or {})
    twin = ["twin.npz", digest_file(folder / "twin.npz")]
    StageRecord(stage="fit", status="ok", files={"twin": twin}, settings=own).save(folder / "fit.json")
    record = run_record(
        scenario=scenario,
        method=method,
        seed=seed,
        status=status,
        reason=reason,
        settings={"fit": own},
        data_digest=digest_file(observations),
        images=images,
        source=source,
        category=category,
        held_file=None if frozen is None else "held.parquet",
        artifacts={"records": ["fit.json"]},
    )
    key = key_of(record.content, {"fit": twin[1], "scores": digest_file(folder / "scores.parquet")})
    replace(record, run_key=key).save(folder / "run.json")
    return folder / "run.json"


def collected(values: dict[tuple[str, str, int], float], failed: tuple[tuple[str, str, int], ...] = ()) -> Collected:
    """Future track errors in meters by (scenario, method, seed), without files; the other runs failed."""
    rows = [(s, "rope", m, seed, "future", "track_error", value, "m", 10) for (s, m, seed), value in values.items()]
    runs = [(*run, "ok", "", "") for run in values] + [(*run, "failed", "diverged", "") for run in failed]
    columns = ["scenario", "method", "seed", "status", "reason", "notes"]
    return Collected(pd.DataFrame(rows, columns=list(SCORE_COLUMNS)), pd.DataFrame(runs, columns=columns))


def all_scores(factor: float = 1.0) -> dict[tuple[str, str], float]:
    """Every metric of both tasks; `factor` scales the errors, and what is better when higher falls with it."""
    one = {"chamfer": 0.01 * factor, "track_error": 0.02 * factor, "psnr": 30 / factor, "ssim": 0.9 / factor}
    one |= {"lpips": 0.05 * factor, "iou": 0.8 / factor}
    return {(task, metric): value for task in ("reconstruction", "future") for metric, value in one.items()}


def write_benchmark(
    results: Path, scenarios: Iterable[str], methods: Mapping[str, float], seeds: Iterable[int] = (0, 1), **facts: Any
) -> None:
    """Runs of every scenario, method and seed; `methods` maps each to the factor of its errors, which scenarios and seeds vary."""
    rng = np.random.default_rng(0)
    for scenario in scenarios:
        size = rng.uniform(0.5, 1.5)
        for seed in seeds:
            for method, factor in methods.items():
                write_run(results, scenario, method, seed, all_scores(size * factor * rng.uniform(0.99, 1.01)), **facts)


def summary(found: Collected, baseline: str = "x") -> str:
    """The scores of a benchmark in Markdown."""
    return summary_text(Numbers(everything=found, baseline=baseline))


def study_text(
    name: str,
    study: Study,
    results: Path,
    scenarios: Iterable[str],
    seeds: Iterable[int],
    methods: Iterable[str],
    folder: Path,
    left_out: LeftOut | None = None,
    beside: Study | None = None,
) -> str:
    """Write the files of a study from the records in a results folder, and its numbers beside its folder; returns the Markdown."""
    found = collect(results, scenarios, methods, seeds, left_out or {})
    known = {name: study} | ({study.beside or "": beside} if beside else {})
    numbers = Numbers(everything=found, baseline="", studies={name: study}, known_studies=known)
    numbers.save(folder.parent)
    made = numbers.by_study[name]
    assert isinstance(made, StudyNumbers)
    return write_study(made, folder)


def tables_in(blocks: Sequence[Block]) -> dict[str, Table]:
    """Tables by their captions, folded ones too."""
    own = {block.caption: block for block in blocks if isinstance(block, Table)}
    return own | {name: table for block in blocks if isinstance(block, Fold) for name, table in tables_in(block.blocks).items()}


def rows_of(table: Table) -> dict[str, dict[str, Cell]]:
    """First cell of a row to its cells by heading; of several rows with the same first cell, the first."""
    rows: dict[str, dict[str, Cell]] = {}
    for row in table.rows:
        rows.setdefault(row[0].text, dict(zip(table.headings, row, strict=True)))
    return rows
