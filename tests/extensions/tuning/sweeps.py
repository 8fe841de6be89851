"""A small sweep for tests and benchmarks: its configuration, its tables and observations on disk, its workers and results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from optuna.study import Study
from optuna.trial import FrozenTrial

from neuspring import config
from neuspring.config.tuning import Tune
from neuspring.core.artifacts import Observations
from neuspring.extensions.tuning import report as tuning_report
from neuspring.extensions.tuning import worker
from neuspring.extensions.tuning.report import state
from neuspring.extensions.tuning.space import Plan
from neuspring.extensions.tuning.worker import counted, origin, study_of
from tests.support import small

OBSERVATIONS = "observations.npz"
BASE = {
    "scenarios": ["small"],
    # Springs begin far too soft, so that a faster rate is better by a tenth, not by last digits that depend on the processor.
    "search": {"rollouts": 11, "fixed": ["stiffness"], "variables": {"stiffness": {"start": 1500.0}}},
    "fit": {"epochs": 3, "learning_rate": 1e-4},
}
METHODS = {
    "search_only": {"search": "uniform", "fit": None, "description": "No second stage"},
    "baseline": {"search": "uniform", "fit": "springs", "description": "Springs"},
    "field": {"search": "uniform", "fit": "field", "description": "Field", "settings": {"horizon": 3}},
}
SEARCHES = {"uniform": {"clusters": 1, "description": "One region"}}
FAST = {"fit.learning_rate": {"low": 1.0e-4, "high": 1.0e-1, "log": True}, "fit.horizon": {"choices": [1, 2]}}
"""Settings of the fit alone, so that one search serves all trials."""


def settings(**changes: Any) -> config.Config:
    """The configuration whose method is varied."""
    values = json.loads(json.dumps(BASE))
    config.merge(values, changes)
    return config.parse(config.Config, values, "test")


def sweep(**changes: Any) -> Tune:
    """A sweep of three trials over settings of the fit."""
    base = {"study": "small", "method": "baseline", "trials": 3, "space": FAST}
    return config.parse(Tune, base | changes, "tune")


def furnish(root: Path, observations: Observations | None = None) -> Path:
    """Write the tables and observations that a sweep reads to a folder; returns the place of the sweep's own folder in it."""
    for name, rows in {"methods": METHODS, "searches": SEARCHES}.items():
        path = root / "config" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(rows))
    (observations or small.observations()).save(root / OBSERVATIONS)
    return root / "study"


def plan(folder: Path, tune: Tune, base: config.Config | None = None) -> Plan:
    """The checked sweep."""
    return Plan.of(base or settings(), tune, folder.parent)


def work(
    folder: Path, tune: Tune, number: int = 0, base: config.Config | None = None, after: Callable[[], object] = lambda: None
) -> list[int]:
    """Run a worker and call `after` after each of its trials; returns the trials that it ran."""
    ended: list[int] = []
    worker.work(
        base or settings(),
        tune,
        [folder.parent / OBSERVATIONS],
        number,
        "cpu",
        folder / f"worker-{number}.json",
        folder.parent,
        lambda number, text: (ended.append(number), after()),  # type: ignore[arg-type, return-value, func-returns-value]
    )
    return ended


def report(folder: Path, tune: Tune, base: config.Config | None = None) -> str:
    """Report a sweep; returns its summary."""
    tuning_report.report(base or settings(), tune, folder / "summary.md", folder.parent)
    return (folder / "summary.md").read_text()


def study(folder: Path, tune: Tune, base: config.Config | None = None) -> Study:
    """The sweep as Optuna has it."""
    return study_of(folder, tune, plan(folder, tune, base).facts())


def trials(folder: Path, tune: Tune, base: config.Config | None = None) -> dict[int, FrozenTrial]:
    """The trials that count."""
    return {origin(trial): trial for trial in counted(study(folder, tune, base))}


def results_of(folder: Path, tune: Tune) -> list[tuple[Any, ...]]:
    """State, value, values and intermediate losses of every trial."""
    ended = trials(folder, tune).values()
    return [(state(trial), trial.value, trial.user_attrs.get("values"), trial.intermediate_values) for trial in ended]
