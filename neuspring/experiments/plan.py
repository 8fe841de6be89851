"""What jobs will cost, from the times that earlier jobs took: for the plan of a dry run, and for what a cluster is asked for.

Times are rates, seconds per unit of a job's work, so that a record made with another budget or of another scene still tells
something. The work of a job that simulates is its spring updates (`neuspring.experiments.size`), in 1e9, so that its rate is in
nanoseconds per spring, substep and twin; that of others is iterations or frames. Records of the results folder come first, then
those that ship with the package (data/tables/timings.csv, each with where it is from).
"""

from __future__ import annotations

import csv
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from neuspring.core.job_records import GIGA_UPDATES, SIMULATING, Attempt, JobRecord, read_jobs
from neuspring.experiments.size import Size

SHIPPED = Path(__file__).parents[1] / "data" / "tables" / "timings.csv"
Kind = Literal["cpu", "gpu"]
IN_MINUTES = 2.0
"""Hours below which a time is told in minutes."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A job that would run."""

    rule: str
    scenario: str = ""
    kind: Kind = "cpu"
    work: float | None = 1.0
    """In units of its rule; None where it cannot be told."""
    size: Size | None = None
    """Of the twins of a job that simulates."""


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Seconds per unit of work, and where that is from."""

    seconds: float
    source: str


@dataclass(frozen=True, kw_only=True)
class History:
    """Earlier jobs of a results folder."""

    rates: Mapping[tuple[str, Kind, str], float] = field(default_factory=dict)
    """(rule, kind, scenario or "" for all) -> median seconds per unit of work."""
    memory: Mapping[tuple[str, Kind, str], float] = field(default_factory=dict)
    """(rule, kind, scenario or "" for all) -> largest resident memory, MiB."""
    uncounted: frozenset[str] = frozenset()
    """Rules that simulate, of which there are jobs whose spring updates nobody counted; their times are not used."""

    @classmethod
    def of(cls, results: Path) -> History:
        """What the job records of a results folder say; damaged ones are passed over."""
        return cls.of_records(read_jobs(results, damaged=[]))

    @classmethod
    def of_records(cls, records: Iterable[JobRecord]) -> History:
        """From job records. The time of a job is that of its last success, with the attempts that it went on from."""
        seconds: dict[tuple[str, Kind, str], list[float]] = defaultdict(list)
        memory: dict[tuple[str, Kind, str], float] = defaultdict(float)
        uncounted = set()
        for record in records:
            for attempt in record.attempts:
                for scenario in {"", record.scenario}:
                    key = (record.rule, _kind(attempt), scenario)
                    memory[key] = max(memory[key], attempt.peak_memory_mb)
            ends = [-1, *(place for place, attempt in enumerate(record.attempts) if attempt.outcome == "ok")]
            if len(ends) == 1:
                continue
            if record.rule in SIMULATING and record.unit != GIGA_UPDATES:
                uncounted.add(record.rule)
                continue
            if not record.work:
                continue  # a fit whose epochs all ran together with those of others
            kind = _kind(record.attempts[ends[-1]])
            took = sum(attempt.seconds for attempt in record.attempts[ends[-2] + 1 : ends[-1] + 1])
            for scenario in {"", record.scenario}:
                seconds[record.rule, kind, scenario].append(took / record.work)
        rates = {key: statistics.median(times) for key, times in seconds.items()}
        return cls(rates=rates, memory=dict(memory), uncounted=frozenset(uncounted))


def _kind(attempt: Attempt) -> Kind:
    return "gpu" if attempt.devices else "cpu"


def shipped_rates(path: Path = SHIPPED) -> dict[tuple[str, str], Rate]:
    """(rule, kind) -> the rate that ships with the package."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = csv.DictReader(line for line in stream if not line.startswith("#"))
        return {(row["rule"], row["kind"]): Rate(seconds=float(row["seconds"]), source=row["source"]) for row in rows}


def rate(job: Planned, history: History, shipped: Mapping[tuple[str, str], Rate]) -> Rate | None:
    """The best known rate for a job; None where nothing is known of its rule."""
    for scenario in (job.scenario, ""):
        if (job.rule, job.kind, scenario) in history.rates:
            return Rate(seconds=history.rates[job.rule, job.kind, scenario], source="this results folder")
    if (job.rule, job.kind) in shipped:
        return shipped[job.rule, job.kind]
    other: Kind = "cpu" if job.kind == "gpu" else "gpu"
    if (job.rule, other) in shipped:
        found = shipped[job.rule, other]
        return Rate(seconds=found.seconds, source=f"{found.source}, for want of a record on a {job.kind.upper()}")
    return None


def report(jobs: Iterable[Planned], history: History, slots: Mapping[Kind, int]) -> str:
    """How many jobs, CPU- and GPU-time are expected, by rule and in all, and what that rests on."""
    shipped = shipped_rates()
    hours: dict[tuple[str, Kind], float] = defaultdict(float)
    counts: dict[tuple[str, Kind], int] = defaultdict(int)
    sources: dict[str, set[str]] = defaultdict(set)
    unknown = set()
    bases: dict[tuple[str, str], set[str]] = defaultdict(set)
    for job in jobs:
        counts[job.rule, job.kind] += 1
        known = rate(job, history, shipped)
        if known is None or job.work is None:
            unknown.add(job.rule)
            continue
        hours[job.rule, job.kind] += known.seconds * job.work / 3600
        sources[known.source].add(job.rule)
        if job.size:
            bases["springs", job.size.springs_from].add(job.scenario)
            bases["substeps", job.size.substeps_from].add(job.scenario)
    if not counts:
        return ""
    totals: dict[Kind, float] = {kind: sum(v for (_, k), v in hours.items() if k == kind) for kind in ("gpu", "cpu")}
    parts = [duration(totals[kind], f"{kind.upper()}-", 1 if totals[kind] < 100 else 0) for kind in totals if totals[kind]]
    lines = [f"Expected: {sum(counts.values())} jobs, {' and '.join(parts) or 'no time on record'}."]
    largest = sorted(hours, key=lambda key: -hours[key])[: 5 if sum(totals.values()) >= IN_MINUTES else None]
    lines += [
        f"  {rule}: {counts[rule, kind]} jobs, {duration(hours[rule, kind], f'{kind.upper()}-', 2)}" for rule, kind in largest
    ]
    least = max([totals[kind] / slots[kind] for kind in totals if slots.get(kind)], default=0.0)
    places = " and ".join(f"{slots[kind]} {'GPU slots' if kind == 'gpu' else 'cores'}" for kind in totals if slots.get(kind))
    if least:
        lines.append(f"  with {places}: at least {duration(least, '', 1)}")
    lines += [f"  times of {', '.join(sorted(rules))}: {source}" for source, rules in sorted(sources.items())]
    lines += [f"  {what} from {source}: {_scenarios(names)}" for (what, source), names in sorted(bases.items())]
    if history.uncounted:
        rules = ", ".join(sorted(history.uncounted))
        lines.append(f"  times of earlier jobs without a count of spring updates are not used: {rules}")
    if unknown:
        lines.append(f"  no time on record, not counted: {', '.join(sorted(unknown))}")
    return "\n".join(lines)


def duration(hours: float, of: str, digits: int) -> str:
    """Hours in words, below two of them in minutes; `of` stands before the unit (GPU-, CPU-)."""
    if hours >= IN_MINUTES:
        return f"{hours:.{digits}f} {of}hours"
    minutes = 60.0 * hours
    return f"{minutes:.0f} {of}minutes" if minutes >= 1.0 else f"less than 1 {of}minute"


def _scenarios(names: set[str]) -> str:
    return f"{len(names)} scenarios" if len(names) > 1 else next(iter(names))
