"""What MLflow holds: searches, and the complete runs as plain data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.core.text import masked
from neuspring.experiments.tracking.store import find, uri_of

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

AGAIN = "commit."
"""Prefix of the tags that name further commits, or a later time, at which the same results were made."""


@dataclass(frozen=True, kw_only=True)
class LoggedRun:
    """A complete run, as MLflow holds it."""

    run_key: str
    """Equal for equal results."""
    scenario: str
    category: str
    method: str
    seed: int
    status: str
    """ok or failed."""
    reason: str
    device: str
    data_digest: str
    commits: dict[str, int]
    """Commit -> when it last made this run, ms since 1970."""
    params: dict[str, str]
    metrics: dict[str, float]
    """Last values."""

    @property
    def place(self) -> tuple[str, str, int]:
        """Scenario, method and seed."""
        return self.scenario, self.method, self.seed


def logged_runs(results: Path, settings: Tracking) -> list[LoggedRun]:
    """All complete runs of the experiment. Raises InputError where MLflow does not answer or has no such experiment."""
    uri = masked(uri_of(Path(results), settings))
    try:
        store = find(Path(results), settings)
        runs = search(*store, logged="complete") if store else None
    except Exception as error:
        reason = masked(str(error).partition("\n")[0])
        raise InputError(
            uri, "MLflow must answer", reason or type(error).__name__, "Start its server, or correct tracking.uri."
        ) from error
    if runs is None:
        raise InputError(uri, f"MLflow must hold the experiment {settings.experiment}", "none", "Run `neuspring sync` first.")
    return [_plain(run) for run in runs if is_complete(run) and "run_key" in run.data.tags]


def search(client: MlflowClient, experiment: str, status: str | None = None, **tags: str) -> list[Run]:
    """All runs of the experiment with this status and these tags (values without quotes: keys, names and numbers)."""
    terms = [f"tags.{name} = '{value}'" for name, value in tags.items()]
    terms += [f"attributes.status = '{status}'"] if status else []
    runs: list[Run] = []
    token: str | None = None
    while True:
        page = client.search_runs([experiment], " and ".join(terms), page_token=token)
        runs += page
        token = page.token
        if not token:
            return runs


def is_complete(run: Run) -> bool:
    """Whether everything of a run was sent."""
    return run.data.tags.get("logged") == "complete" and run.info.status in ("FINISHED", "FAILED")


def _plain(run: Run) -> LoggedRun:
    tags = run.data.tags
    commits = {tags["commit"]: run.info.end_time or 0}
    commits |= {name.removeprefix(AGAIN): int(value) for name, value in tags.items() if name.startswith(AGAIN)}
    names = ("run_key", "scenario", "category", "method", "status", "reason", "device", "data_digest")
    return LoggedRun(
        **{name: tags[name] for name in names},
        seed=int(tags["seed"]),
        commits=commits,
        params=run.data.params,
        metrics=run.data.metrics,
    )
