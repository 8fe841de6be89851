"""Functions that the workflow's rules of a sweep call."""

from __future__ import annotations

import json
from typing import Any

from neuspring.config import plain
from neuspring.config.settings import select
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import Benchmark
from neuspring.extensions.tuning.space import Plan


def check(benchmark: Benchmark, *, cluster: bool) -> None:
    """Raise InputError for a sweep that cannot run, before any job exists."""
    tune = benchmark.config.tune
    assert tune
    Plan.of(benchmark.config, tune, benchmark.root)
    if cluster and tune.workers > 1 and tune.storage is None:
        rule = "workers on several machines need storage: postgresql://...; SQLite serves one machine"
        raise InputError("configuration, tune.storage", rule, None, "Set a PostgreSQL database, or workers: 1.")


def settings(benchmark: Benchmark) -> str:
    """Settings of a sweep's workers, as JSON, with absolute paths of the tables of methods and searches."""
    values = select(benchmark.config, ("clusters", "simulation", "losses", "search", "fit", "released_quirks", "tune"))
    tables: dict[str, Any] = {
        name: str(benchmark.root / getattr(benchmark.config, name)) for name in ("method_table", "search_table")
    }
    tables["extra_rows"] = {name: str(benchmark.root / path) for name, path in benchmark.config.extra_rows.items()}
    return json.dumps(values | tables | {"scenarios": list(benchmark.whole.scenarios)}, sort_keys=True)


def rows(benchmark: Benchmark) -> str:
    """The entries of the varied method and its search: Snakemake reruns the sweep if they change."""
    assert benchmark.config.tune
    plan = Plan.of(benchmark.config, benchmark.config.tune, benchmark.root)
    return json.dumps([plain(plan.method), plain(plan.row)], sort_keys=True)
