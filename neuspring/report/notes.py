"""Findings of finished runs: springs at a limit, a search at the end of its range, a fit without improvement."""

from __future__ import annotations

from collections.abc import Iterable

from neuspring.checks import examine
from neuspring.core.findings import Finding
from neuspring.core.run_record import RunRecord


def of_fits(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding for each fit with springs at a limit of their stiffness; the finding names the setting to change."""
    return [(run.scenario, finding) for run in runs for finding in examine("fit", f"{run.method}/{run.seed}", run)]


def of_runs(runs: Iterable[RunRecord]) -> list[tuple[str, Finding]]:
    """Scenario and finding of all searches and fits, including the findings of `of_fits`."""
    runs = list(runs)
    findings = of_fits(runs)
    for run in runs:
        facts = run.params
        ends = facts.get("search.result.at_ends")
        springs, inner, vertices = (
            facts.get(f"fit.result.{name}", facts.get(f"search.result.{name}"))
            for name in ("springs", "object_springs", "vertices")
        )
        cases = [
            (
                ends,
                "search at an end of its range",
                f"The best value of {ends} is at a limit.",
                f"Widen search.variables for {ends}.",
            ),
            (
                facts.get("fit.result.best_epoch", 1) < 0,
                "training improved nothing",
                "No epoch reduced the loss.",
                "Lower fit.learning_rate.",
            ),
            (
                vertices is None and springs is not None and springs == inner,
                "no spring joins a controller to the object",
                "No controller can move the object.",
                "Look at the controllers in lifted.png.",
            ),
        ]
        where = f"{run.method}/{run.seed}"
        findings += [
            (run.scenario, Finding(name=name, level="warning", where=where, text=f"{text} {remedy}", remedy=remedy))
            for applies, name, text, remedy in cases
            if applies
        ]
    return findings
