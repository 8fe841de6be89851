"""Compare the runs of two commits in MLflow: paired differences of scores and times, and what else differs.

A run belongs to the commit that scored it. Its earlier stages may have been run by an older commit with the same code. Results that
are equal in both commits are one run of both. An index that was rebuilt from the files knows only the newest commit of a run.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.experiments.tracking.store import LoggedRun, logged_runs
from neuspring.scores.metrics import METRICS, TASKS, UNITS
from neuspring.scores.statistics import paired_differences

DIRTY = "-dirty"
SECONDS = "seconds"
"""The `task` of timings; their `metric` is the stage."""
KEYS = ("method", "task", "metric")
MEANS = ("mean_first", "mean_second")
INTERVALS = ("difference", "low", "high", "relative", "scenarios", "ratio", "ratio_low", "ratio_high")
COLUMNS = (*KEYS, "unit", "first", "second", "pairs", *MEANS, *INTERVALS)
LISTED = 20
"""Lines of a list in Markdown."""
SHORT, LONG = 12, 60
"""Characters shown of a commit, and of a parameter."""
Pair = tuple[LoggedRun, LoggedRun]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Two commits' newest runs."""

    commits: tuple[str, str]
    """In full."""
    pairs: list[Pair]
    """Of the same scenario, method and seed; the same run twice where both commits made the same results."""
    only: tuple[list[LoggedRun], list[LoggedRun]]
    """Runs of the first and of the second commit that the other one has not."""
    differences: pd.DataFrame
    """Second minus first on the pairs that succeeded in both, by method, task and metric (see COLUMNS); m, dB, s."""


def compare(results: Path, settings: Tracking, first: str, second: str, output: Path | None = None) -> str:
    """Compare two commits, named by their beginnings; those of changed working copies end in `-dirty` and are others.

    Returns Markdown; writes the differences as CSV to `output`. Raises InputError where MLflow does not answer, for the same
    commit twice, and for one that has no run or whose name is ambiguous.
    """
    runs = logged_runs(results, settings)
    comparison = pair(runs, _resolve(runs, first), _resolve(runs, second))
    if output is not None:
        write_text(output, comparison.differences.to_csv(index=False))
    return to_markdown(comparison)


def pair(runs: list[LoggedRun], first: str, second: str) -> Comparison:
    """Pair the newest runs of two commits, given in full. Raises InputError if they are the same."""
    if first == second:
        raise InputError("commits", "two different ones are required", first)
    a, b = _newest(runs, first), _newest(runs, second)
    pairs = [(a[place], b[place]) for place in sorted(a.keys() & b.keys())]
    only = ([a[place] for place in sorted(a.keys() - b.keys())], [b[place] for place in sorted(b.keys() - a.keys())])
    return Comparison(commits=(first, second), pairs=pairs, only=only, differences=_differences(pairs, first, second))


def _newest(runs: list[LoggedRun], commit: str) -> dict[tuple[str, str, int], LoggedRun]:
    """Scenario, method and seed -> the run that the commit made last."""
    own = sorted((run for run in runs if commit in run.commits), key=lambda run: run.commits[commit])
    return {run.place: run for run in own}


def _resolve(runs: list[LoggedRun], text: str) -> str:
    """The one known commit that begins with `text` (before `-dirty`)."""
    counts = Counter(commit for run in runs for commit in run.commits if commit)
    stem, dirty = text.removesuffix(DIRTY), text.endswith(DIRTY)
    matches = [name for name in counts if name.startswith(stem) and name.endswith(DIRTY) == dirty] if stem else []
    if text in counts or len(matches) == 1:
        return text if text in counts else matches[0]
    latest = {commit: max(run.commits[commit] for run in runs if commit in run.commits) for commit in counts}
    recent = sorted(counts, key=lambda commit: latest[commit], reverse=True)[:LISTED]
    listed = ", ".join(f"{name} ({counts[name]} run{'s' * (counts[name] > 1)})" for name in recent) or "none"
    rule = "must begin the name of one commit only" if matches else "this commit must have complete runs in MLflow"
    raise InputError(f"commit {text!r}", rule, ", ".join(matches) or "none", f"Known, newest first: {listed}.")


def _differences(pairs: list[Pair], first: str, second: str) -> pd.DataFrame:
    scores = pd.DataFrame(_scores(pairs, first, second), columns=["commit", "scenario", "seed", *KEYS, "value"])
    rows = []
    for method, part in scores.groupby("method", sort=False):
        # To the bootstrap the commits are what methods are in a table.
        part = part.assign(method=part["commit"])
        for row in paired_differences(part, first).to_dict("records"):
            values = part[(part["task"] == row["task"]) & (part["metric"] == row["metric"])]
            by_commit = values.pivot_table(index=["scenario", "seed"], columns="commit", values="value").dropna()
            means = by_commit.groupby("scenario").mean().mean()
            row |= {"method": method, "unit": _unit(str(row["task"]), str(row["metric"])), "first": first, "second": second}
            rows.append(row | {"pairs": len(by_commit), "mean_first": means[first], "mean_second": means[second]})
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _scores(pairs: list[Pair], first: str, second: str) -> Iterator[tuple[object, ...]]:
    """Rows of scores and times of the pairs that succeeded in both. Equal times are left out: the stage ran only once."""
    for a, b in pairs:
        if (a.status, b.status) != ("ok", "ok"):
            continue
        for commit, run, other in ((first, a, b), (second, b, a)):
            for name, value in run.metrics.items():
                task, _, metric = name.partition(".")
                ran_again = task == SECONDS and value != other.metrics.get(name)
                if ran_again or (task in TASKS and metric in UNITS and math.isfinite(value)):
                    yield commit, run.scenario, run.seed, run.method, task, metric, value


def _unit(task: str, metric: str) -> str:
    return "s" if task == SECONDS else UNITS[metric]


def to_markdown(comparison: Comparison) -> str:
    """A comparison as Markdown; errors in mm."""
    (first, second), pairs = comparison.commits, comparison.pairs
    same = sum(a.run_key == b.run_key for a, b in pairs)
    failed = [(a, b) for a, b in pairs if "failed" in (a.status, b.status)]
    alike = f", of which {same} with the same results, bit for bit" if same else ""
    lines = [f"# {_short(second)} minus {_short(first)}", "", f"{len(pairs)} pairs of the same scenario, method and seed{alike}."]
    if len(failed) < len(pairs):
        lines += _score_lines(comparison.differences, _short(first), _short(second))
    else:
        lines += ["", "No pair succeeded in both: nothing to compare."]
    lines += _other_lines(pairs)
    lines += _list("Failed, and not in the table", [f"{_name(a)}: {_outcome(a, first)}, {_outcome(b, second)}" for a, b in failed])
    for commit, runs in zip(comparison.commits, comparison.only, strict=True):
        lines += _list(f"Only in {_short(commit)}", [_name(run) for run in runs])
    return "\n".join([*lines, *_parameter_lines(pairs, _short(first), _short(second))]) + "\n"


def _score_lines(differences: pd.DataFrame, first: str, second: str) -> list[str]:
    heads = ["Method", "Task", "Metric", first, second, "Difference [95 % interval]", "Ratio", "Pairs"]
    what = "Means over scenarios; intervals are bootstrapped over scenarios and seeds."
    lines: list[str] = []
    timed = differences["task"] == SECONDS
    for title, part in (("Scores", differences[~timed]), ("Time of the stages that ran again", differences[timed])):
        if len(part):
            lines += [
                "",
                f"## {title}",
                "",
                what,
                "",
                *Table.of_texts(heads, [_cells(row) for row in part.itertuples()]).markdown(),
            ]
    return lines


def _cells(row: Any) -> list[str]:
    metric = METRICS.get(row.metric)
    factor, digits = (metric.factor, metric.digits) if metric else (1.0, 1)
    unit = {"m": "mm", "1": ""}.get(row.unit, row.unit)
    first, second = (f"{factor * value:.{digits}f}" for value in (row.mean_first, row.mean_second))
    difference = f"{factor * row.difference:+.{digits}f}"
    if math.isfinite(row.low):
        difference += f" [{factor * row.low:+.{digits}f}, {factor * row.high:+.{digits}f}]"
    # A ratio of decibels means nothing.
    ratio = f"{row.ratio:.3f}" if math.isfinite(row.ratio) and unit != "dB" else "–"
    return [row.method, row.task, f"{row.metric}, {unit}".removesuffix(", "), first, second, difference, ratio, str(row.pairs)]


def _other_lines(pairs: list[Pair]) -> list[str]:
    """What differs besides the code: data and devices."""
    data = sorted({a.scenario for a, b in pairs if a.data_digest != b.data_digest})
    devices = Counter((a.device, b.device) for a, b in pairs if a.device != b.device)
    lines = []
    if data:
        lines += ["", f"**The data differ** ({', '.join(data)}): this compares more than code."]
    if devices:
        shown = ", ".join(f"{a} and {b}: {count} pairs" for (a, b), count in devices.items())
        lines += ["", f"**The devices differ** ({shown}): this compares more than code."]
    return lines


def _parameter_lines(pairs: list[Pair], first: str, second: str) -> list[str]:
    """Settings that differ. Parameters with `.result.` in their names are results, not settings."""
    changed: dict[tuple[str, str, str], Counter[str]] = {}
    for a, b in pairs:
        for name in sorted(a.params.keys() | b.params.keys()):
            before, after = a.params.get(name, "–"), b.params.get(name, "–")
            if before != after and ".result." not in name:
                changed.setdefault((name, before, after), Counter())[a.method] += 1
    if not changed:
        return ["", "## Changed parameters", "", "None."] if pairs else []
    rows = [[name, _cut(a), _cut(b), ", ".join(of), str(of.total())] for (name, a, b), of in sorted(changed.items())]
    return ["", "## Changed parameters", "", *Table.of_texts(["Parameter", first, second, "Methods", "Pairs"], rows).markdown()]


def _list(title: str, names: list[str]) -> list[str]:
    if not names:
        return []
    rest = [f"- and {len(names) - LISTED} more"] if len(names) > LISTED else []
    return ["", f"## {title}", "", *(f"- {name}" for name in names[:LISTED]), *rest]


def _name(run: LoggedRun) -> str:
    return f"{run.scenario} / {run.method} / seed {run.seed}"


def _outcome(run: LoggedRun, commit: str) -> str:
    return f"{_short(commit)} {run.status}" + (f" ({run.reason})" if run.reason else "")


def _short(commit: str) -> str:
    stem = commit.removesuffix(DIRTY)
    return stem[:SHORT] + commit[len(stem) :]


def _cut(text: str) -> str:
    return (text if len(text) <= LONG else f"{text[:LONG]}…").replace("|", "\\|")
