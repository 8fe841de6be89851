"""The answer in words: who wins, whether that is resolved, what went wrong, the probable cause, and the next move.

It stands first on the page, in summary.md and on the terminal, and says only what runs measured and recorded.
"""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING, Any

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.core.text import listed
from neuspring.report.blocks import Text
from neuspring.report.notes import causes
from neuspring.report.study_cells import LEAST_SCENARIOS
from neuspring.scores import statistics
from neuspring.scores.metrics import METRICS, averages

if TYPE_CHECKING:
    from neuspring.report.benchmark import Benchmark

JUDGES = tuple((task, name) for task in ("future", "reconstruction") for name in ("track_error", "chamfer", "image_error"))
"""Task and metric that decide: the first one that the runs have."""
FRAMES = {"future": "future", "reconstruction": "training"}
NOUNS = {"scenario": "scenarios", "category": "categories"}
"""What intervals of ratios are over."""
MOST = 3
"""Rivals, scenarios, causes and moves that are named."""
GROWS = 2.0
"""A future error of so many times that on training frames is a drift."""
ONE_SEED = "Seeds 0, 1 and 2 would tell how much is chance in training."


def verdict(benchmark: Benchmark) -> list[Text]:
    """Labeled paragraphs on a benchmark."""
    runs, usable = benchmark.collected.runs, benchmark.usable
    there = set(zip(usable["task"], usable["metric"], strict=True)) if len(usable) else set()
    key = next((key for key in JUDGES if key in there), None)
    if key is None:
        ended = int((runs["status"] == "ok").sum())
        said = {"Who wins": [f"Nothing can be compared yet: {ended} of {len(runs)} runs have finished."]}
        return _paragraphs(said | {"What went wrong": _unfinished(runs)})
    duel = Duel(benchmark, *key)
    why = [*duel.drift(), *duel.causes()][:MOST]
    said = {
        "Who wins": duel.winner(),
        "Is it resolved": duel.resolved(),
        "What went wrong": [*_unfinished(runs), *duel.weak(), *duel.others()] or ["Nothing that the runs recorded."],
        "Probable cause": [cause for cause, _ in why],
        "Next move": list(dict.fromkeys(move for _, move in why if move)),
    }
    return _paragraphs(said)


def headline(summary: str) -> str:
    """The first table of a summary in Markdown, with the lines above it but not the heading: what a terminal shows."""
    before, bar, rest = summary.partition("\n|")
    rows = "".join(itertools.takewhile(lambda line: line.startswith("|"), (bar[1:] + rest).splitlines(keepends=True)))
    lines = [line for line in before.replace("**", "").splitlines() if not line.startswith("#")]
    return re.sub(r"\n{3,}", "\n\n", "\n".join([*lines, "", rows])).strip()


def _paragraphs(said: dict[str, list[str]]) -> list[Text]:
    return [Text(label=label, text=" ".join(sentences)) for label, sentences in said.items() if sentences]


def _unfinished(runs: pd.DataFrame) -> list[str]:
    """Failed runs with the first reason, and how many runs have not finished."""
    failed, missing = runs[runs["status"] == "failed"], int((runs["status"] == "missing").sum())
    said = [f"{missing} of {len(runs)} runs have not finished."] if missing else []
    if len(failed):
        first = failed.iloc[0]
        said.append(f"{len(failed)} of {len(runs)} runs failed, first {first['method']} on {first['scenario']}: {first['reason']}.")
    return said


class Duel:
    """The best method by one error, and its rival: what it is compared with, or the second best where it is that itself."""

    def __init__(self, benchmark: Benchmark, task: str, name: str) -> None:
        self.benchmark, self.task, self.metric = benchmark, task, METRICS[name]
        usable = benchmark.usable
        part = usable[(usable["task"] == task) & (usable["metric"] == name)]
        means = averages(part).set_index("method")["equal"].sort_values(kind="stable")
        self.means = {str(method): float(value) for method, value in means.items()}
        self.best, *others = self.means
        self.rival = benchmark.baseline if benchmark.baseline in others else next(iter(others), "")
        self.scenarios, self.seeds = part["scenario"].nunique(), part["seed"].nunique()
        finished = benchmark.finished[benchmark.finished["metric"] == name]
        each = finished.groupby(["method", "task", "scenario"])["value"].mean()
        self.each: dict[Any, float] = dict(zip(each.index.tolist(), each.tolist(), strict=True))
        own = {scenario: value for (method, at, scenario), value in self.each.items() if (method, at) == (self.best, task)}
        self.by_scenario = dict(sorted(own.items(), key=lambda pair: -pair[1]))
        self.weakest = next(iter(self.by_scenario))

    def text(self, value: float) -> str:
        """An error with its unit."""
        return f"{self.metric.text(value)} {self.metric.shown_unit}"

    def winner(self) -> list[str]:
        """Who is best, by how much."""
        what = f"{self.metric.title} on {FRAMES[self.task]} frames"
        if not self.rival:
            return [f"{self.best} is alone: its {what} is {self.text(self.means[self.best])}."]
        first, second = self.text(self.means[self.best]), self.text(self.means[self.rival])
        if first == second:
            return [f"Nobody: {self.best} and {self.rival} have the same {what}, {first}."]
        lead = {name: 100 * (1 - self.means[self.best] / value) for name, value in self.means.items() if value > 0}
        names = [self.rival, *(name for name in self.means if name not in (self.best, self.rival))]
        beaten = [f"{lead[name]:.0f} % below {name} ({self.text(self.means[name])})" for name in names[:MOST] if name in lead]
        over = f", mean over {self.scenarios} scenarios" if self.scenarios > 1 else f" in {self.weakest}"
        return [f"{self.best}, by {what}: {first}{over}. That is {' and '.join(beaten)}."]

    def resolved(self) -> list[str]:
        """Whether the lead over the rival is more than chance, and what would show it if not."""
        if not self.rival:
            return []
        found = self.benchmark.finished
        pair = found[found["method"].isin([self.best, self.rival]) & (found["task"] == self.task)]
        table = statistics.ratios(pair[pair["metric"] == self.metric.name], self.rival, self.benchmark.objects)
        more = [ONE_SEED] if self.seeds == 1 else []
        if not len(table) or table.iloc[0]["verdict"] == statistics.TOO_FEW:
            count = f"{self.scenarios} scenario{'s' * (self.scenarios > 1)}"
            return [f"No. {count} cannot tell a lead from chance; {statistics.LEAST_OBJECTS} give an interval.", *more]
        row = table.iloc[0]
        ends = f"{row['ratio_low']:.3f} to {row['ratio_high']:.3f}"
        nouns = NOUNS[row["objects"]]
        what = f"Over {row['n']} {nouns} the ratio of its error to that of {self.rival} is {row['ratio']:.3f}"
        if row["verdict"] == statistics.BELOW:
            if row["n"] < LEAST_SCENARIOS:
                return [f"Not yet. {what}, interval {ends}: below 1, but fewer than {LEAST_SCENARIOS} are too few.", *more]
            return [f"Yes. {what}, interval {ends}: below 1.", *more]
        if row["verdict"] == statistics.ABOVE:
            return [f"No. {what}, interval {ends}: above 1. A few large errors of {self.rival} make its mean.", *more]
        most = statistics.needed(row["ratio_low"], row["ratio_high"], int(row["n"]))
        would = f"{most} {nouns} that scatter alike would resolve it." if most else "The lead is too small to be resolved."
        return [f"No. {what}, interval {ends}: 1 lies in it. {would}", *more]

    def weak(self) -> list[str]:
        """Where the best method is weakest, where its rival is better, and whether it learned anything at all."""
        said = []
        if len(self.by_scenario) > 1:
            said.append(f"{self.best} is weakest in {self.weakest} ({self.text(self.by_scenario[self.weakest])}).")
        rivals = {name: self.each.get((self.rival, self.task, name)) for name in self.by_scenario}
        worse = [name for name, value in rivals.items() if value is not None and value < self.by_scenario[name]]
        said += [f"{self.rival} is better in {listed(worse, MOST)}."] if worse else []
        return [*said, f"{self.best} learns nothing, and no method that learns is better."] if self.best in REFERENCES else said

    def others(self) -> list[str]:
        """Other measures of the same frames by which another method is first."""
        usable, first = self.benchmark.usable, dict[str, list[str]]()
        for name, part in usable[usable["task"] == self.task].groupby("metric", sort=False):
            metric, values = METRICS[str(name)], averages(part).set_index("method")["equal"]
            leader = str(values.idxmax() if metric.higher_is_better else values.idxmin())
            if self.best in values and values[leader] != values[self.best]:
                against = f"{metric.heading} ({metric.text(values[leader])} against {metric.text(values[self.best])})"
                first.setdefault(leader, []).append(against)
        return [f"By other measures {leader} is first: {', '.join(found)}." for leader, found in first.items()]

    def causes(self) -> list[tuple[str, str]]:
        """What records say, with the next move, weakest scenario first: warnings of perception there, then search and fit."""
        warned = [one for scenario, one in self.benchmark.warnings if scenario == self.weakest]
        found = [(f"{self.weakest}: {one.name} ({one.where}).", one.remedy) for one in warned]
        for scenario in self.by_scenario:
            records = self.benchmark.everything.records.items()
            own = [record for (place, method, _), record in records if (place, method) == (scenario, self.best)]
            found += [(f"{self.best} on {scenario}: {cause}.", move) for cause, move in causes(own)]
        return found

    def drift(self) -> list[tuple[str, str]]:
        """Whether the error of the weakest scenario is there from the start or grows where the twin predicts."""
        trained = self.each.get((self.best, "reconstruction", self.weakest))
        if self.task != "future" or not trained:
            return []
        numbers = f"{self.text(trained)} on training frames, {self.text(self.by_scenario[self.weakest])} in the future"
        if self.by_scenario[self.weakest] > GROWS * trained:
            cause = f"In {self.weakest} it fits what it saw and drifts after it ({numbers})."
            return [(cause, f"Look in the film of {self.weakest} for the frame in which it drifts, and train on such motion too.")]
        where = f"In {self.weakest} the error is there on training frames already ({numbers})."
        return [(where, f"Look at masks and tracks of {self.weakest} first.")]
