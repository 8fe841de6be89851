"""Results without runs: records, scores and substitutes for the files of stages."""

from collections.abc import Mapping
from dataclasses import replace

import pandas as pd

from neuspring.core.records import StageRecord, digest_file
from neuspring.core.run_record import key_of
from neuspring.core.table import Table
from neuspring.report.blocks import Fold
from neuspring.scores.metrics import METRICS, SCORE_COLUMNS
from neuspring.scores.table import RUN_COLUMNS, TABLE_COLUMNS, ScoreTable
from tests.support.runs import run_record

Scores = Mapping[tuple[str, str], float]
"""By task and metric, in our units."""


def write_run(
    results,
    scenario,
    method,
    seed,
    scores,
    *,
    frames=10,
    category="rope",
    source="phystwin",
    status="ok",
    reason="",
    images=None,
    settings=None,
    frozen=None,
):
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


def collected(values, failed=(), **facts):
    """A table without files: scores (or a future track error, m) by scenario, method, seed; `failed` runs have none."""
    rows, runs = [], []
    for (scenario, method, seed), given in values.items():
        scores = given if isinstance(given, Mapping) else {("future", "track_error"): given}
        name = f"{scenario}/{method}/{seed}"
        for (task, metric), value in scores.items():
            unit = METRICS[metric].unit if metric in METRICS else "m"
            rows.append((name, method, scenario, "rope", seed, task, metric, 10, value, unit))
        runs.append({"run": name, "scenario": scenario, "method": method, "seed": seed, "status": "ok", "reason": ""})
    for scenario, method, seed in failed:
        name = f"{scenario}/{method}/{seed}"
        runs.append({"run": name, "scenario": scenario, "method": method, "seed": seed, "status": "failed", "reason": "diverged"})
    rest = {"notes": "", "images": "null", "source": "", "run_key": "", "oracle": False, "settings": "{}"} | facts
    table = pd.DataFrame(runs).assign(**rest).reindex(columns=list(RUN_COLUMNS))
    return ScoreTable(pd.DataFrame(rows, columns=list(TABLE_COLUMNS)), table)


def all_scores(factor=1.0):
    """Every metric of both tasks; `factor` scales the errors, and what is better when higher falls with it."""
    one = {"chamfer": 0.01 * factor, "track_error": 0.02 * factor, "psnr": 30 / factor, "ssim": 0.9 / factor}
    one |= {"lpips": 0.05 * factor, "iou": 0.8 / factor}
    return {(task, metric): value for task in ("reconstruction", "future") for metric, value in one.items()}


def tables_in(blocks):
    """Tables by their captions, folded ones too."""
    own = {block.caption: block for block in blocks if isinstance(block, Table)}
    return own | {name: table for block in blocks if isinstance(block, Fold) for name, table in tables_in(block.blocks).items()}


def rows_of(table):
    """First cell of a row to its cells by heading; of several rows with the same first cell, the first."""
    rows = {}
    for row in table.rows:
        rows.setdefault(row[0].text, dict(zip(table.header, row, strict=True)))
    return rows
