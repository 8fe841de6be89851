"""Findings of finished runs: springs at a limit, a search at the end of its range, a training that improved nothing."""

from __future__ import annotations

from collections.abc import Iterable

from neuspring.checks import examine
from neuspring.core.findings import Finding
from neuspring.core.run_record import RunRecord


def of_fits(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of all fits: springs at a limit of their stiffness, with the setting that widens it."""
    return [(run.scenario, one) for run in runs for one in examine("fit", f"{run.method}/{run.seed}", run)]


def of_runs(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of searches and fits, those of `of_fits` included."""
    runs = list(runs)
    found = of_fits(runs)
    for run in runs:
        facts = run.params
        ends = str(facts.get("search.result.at_ends") or "")
        springs, inner = (
            facts.get(f"fit.result.{name}", facts.get(f"search.result.{name}")) for name in ("springs", "object_springs")
        )
        of_rods = "fit.result.vertices" in facts or "search.result.vertices" in facts
        cases = [
            (bool(ends), "search at an end of its range", ends, f"Widen search.variables for {ends}."),
            (
                facts.get("fit.result.best_epoch", 1) < 0,
                "training improved nothing",
                "none",
                "Lower fit.learning_rate.",
            ),
            (
                springs is not None and springs == inner and not of_rods,
                "no spring joins a controller to the object",
                "nothing moves it",
                "Look at the controllers in lifted.png.",
            ),
        ]
        where = f"{run.method}/{run.seed}"
        found += [
            (run.scenario, Finding(name=name, level="warning", where=where, text=f"{text}. {remedy}", remedy=remedy))
            for is_so, name, text, remedy in cases
            if is_so
        ]
    return found
