"""Section of the MLflow index of many runs: a run is logged as the workflow does it, and its rows are copied in the database."""

from __future__ import annotations

import sqlite3
import tempfile
import time
from contextlib import closing
from pathlib import Path

from neuspring.config import Tracking
from neuspring.experiments.tracking.log import log_run
from neuspring.experiments.tracking.store import connect, page
from tests.benchmarks.rows import Bench
from tests.benchmarks.simulators import Times
from tests.benchmarks.table import Row
from tests.support.stores import write_run

RUNS, PAGE = 10_000, 100
"""Runs in the index, and those of a page of MLflow's table."""
MOST = 2.0
"""s of a processor that each row may take at most."""
TABLES = ("params", "tags", "latest_metrics")
"""Tables of a run beside `runs`. Histories, in `metrics`, are read one run at a time."""


def by_runs(bench: Bench) -> list[Row]:
    """Open the index, a page of its table, a filtered page, and log one more run: seconds of a processor. On the CPU alone.

    Raises AssertionError for a row over its bound.
    """
    if bench.device != "cpu":
        return []
    count, settings = RUNS // 10 if bench.quick else RUNS, Tracking()
    with tempfile.TemporaryDirectory() as place:
        results = Path(place) / "results"
        results.mkdir()
        assert log_run(write_run(results), results, settings) == "logged"
        multiply(results / "mlflow.db", count)
        client, experiment = connect(results, settings)
        # Statistics are made when the pages are opened.
        page(results, settings)
        best, of_scenario = (
            ["metrics.`scores/future.chamfer_mm` ASC"],
            f"tags.scenario = 'scene{count // 2}' and params.fit = 'springs'",
        )
        assert len(client.search_runs([experiment], max_results=PAGE, order_by=best)) == PAGE
        assert len(client.search_runs([experiment], of_scenario)) == 1
        extra = iter(range(count, count + 9))
        ways = {
            "open": lambda: page(results, settings),
            "table": lambda: client.search_runs([experiment], max_results=PAGE, order_by=best),
            "filter": lambda: client.search_runs([experiment], of_scenario, max_results=PAGE, order_by=best),
            "log one more": lambda: log_run(write_run(results, seed=next(extra)), results, settings),
        }
        rows = []
        for name, way in ways.items():
            spent = []
            for _ in range(3):
                begin = time.process_time()
                way()
                spent.append(time.process_time() - begin)
            its = Times(tuple(spent))
            assert its.least < MOST, f"{name}, {count:,} runs: {its.least:.1f} s, at most {MOST} s are allowed"
            rows.append(
                Row(section="tracking", name=f"{name}, {count:,} runs", device="cpu", unit="s", median=its.median, least=its.least)
            )
    return rows


def multiply(database: Path, count: int) -> None:
    """Copy the only run of an index until there are `count`: their scenarios and scores differ."""
    with closing(sqlite3.connect(database)) as db, db:
        numbers = f"(WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < {count - 1}) SELECT i FROM n)"
        for table in ("runs", *TABLES):
            columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
            changed = {"run_uuid": "run_uuid || '-' || i"}
            if table == "tags":
                changed["value"] = "CASE key WHEN 'scenario' THEN 'scene' || i WHEN 'run_key' THEN value || i ELSE value END"
            elif table == "latest_metrics":
                changed["value"] = "value * (1 + i * 1e-4)"
            values = ", ".join(changed.get(column, f'"{column}"') for column in columns)
            names = ", ".join(f'"{column}"' for column in columns)
            db.execute(f"INSERT INTO {table} ({names}) SELECT {values} FROM {table}, {numbers}")
