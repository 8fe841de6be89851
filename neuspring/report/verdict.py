"""The answer in words: who wins, whether that is resolved, what went wrong, the probable cause, and the next move.

It stands first on the page, in summary.md and on the terminal, and says only what runs measured and recorded.
"""

from __future__ import annotations

import itertools
import re
from typing import Any, cast

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.core.text import listed
from neuspring.report.blocks import Text
from neuspring.report.notes import causes
from neuspring.scores import statistics
from neuspring.scores.metrics import METRICS
from neuspring.scores.numbers import Numbers
from neuspring.scores.study import LEAST_SCENARIOS

TASK_FRAMES = {"future": "future", "reconstruction": "training"}
NOUNS = {"scenario": "scenarios", "category": "categories"}
"""Objects that intervals of ratios are over."""
MOST_SAID = 3
"""Rivals, scenarios, causes and moves that are named."""
GROWS = 2.0
"""A future error of so many times that on training frames is a drift."""
ONE_SEED = "Seeds 0, 1 and 2 would tell how much is chance in training."


def verdict(numbers: Numbers) -> list[Text]:
    """Labeled paragraphs on a benchmark."""
    runs = numbers.collected.runs
    if not len(numbers.lead):
        ended = int((runs["status"] == "ok").sum())
        said = {"Who wins": [f"Nothing can be compared yet: {ended} of {len(runs)} runs have finished."]}
        return _paragraphs(said | {"What went wrong": _unfinished(runs)})
    duel = Duel(numbers)
    why = [*duel.drift(), *duel.causes()][:MOST_SAID]
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
    """The words on `Numbers.lead`: the best method by the error that decides, and its rival."""

    def __init__(self, numbers: Numbers) -> None:
        self.numbers, self.lead = numbers, cast("Any", next(numbers.lead.itertuples()))
        self.best, self.rival, self.task, self.metric = (
            str(self.lead.method), str(self.lead.baseline), str(self.lead.task), METRICS[str(self.lead.metric)]
        )  # fmt: skip
        self.means = numbers.means(self.task, self.metric.name)
        usable, finished = numbers.usable, numbers.finished[numbers.finished["metric"] == self.metric.name]
        part = usable[(usable["task"] == self.task) & (usable["metric"] == self.metric.name)]
        self.scenarios, self.seeds = part["scenario"].nunique(), part["seed"].nunique()
        each: Any = finished.groupby(["method", "task", "scenario"])["value"].mean().to_dict()
        self.each: dict[tuple[str, str, str], float] = each
        own = {scenario: value for (method, at, scenario), value in self.each.items() if (method, at) == (self.best, self.task)}
        self.by_scenario = dict(sorted(own.items(), key=lambda pair: -pair[1]))
        self.weakest = next(iter(self.by_scenario))

    def text(self, value: float) -> str:
        """An error with its unit."""
        return f"{self.metric.text(value)} {self.metric.shown_unit}"

    def winner(self) -> list[str]:
        """Who is best, by how much."""
        what = f"{self.metric.title} on {TASK_FRAMES[self.task]} frames"
        if not self.rival:
            return [f"{self.best} is alone: its {what} is {self.text(self.means[self.best])}."]
        first, second = self.text(self.means[self.best]), self.text(self.means[self.rival])
        if first == second:
            return [f"Nobody: {self.best} and {self.rival} have the same {what}, {first}."]
        lead = {name: 100 * (1 - self.means[self.best] / value) for name, value in self.means.items() if value > 0}
        names = [self.rival, *(name for name in self.means if name not in (self.best, self.rival))]
        beaten = [f"{lead[name]:.0f} % below {name} ({self.text(self.means[name])})" for name in names[:MOST_SAID] if name in lead]
        over = f", mean over {self.scenarios} scenarios" if self.scenarios > 1 else f" in {self.weakest}"
        return [f"{self.best}, by {what}: {first}{over}. That is {' and '.join(beaten)}."]

    def resolved(self) -> list[str]:
        """The answer to: is the lead over the rival more than chance, and what would show it if not?"""
        if not self.rival:
            return []
        row, more = self.lead, [ONE_SEED] if self.seeds == 1 else []
        if row.verdict == statistics.TOO_FEW:
            count = f"{self.scenarios} scenario{'s' * (self.scenarios > 1)}"
            return [f"No. {count} cannot tell a lead from chance; {statistics.LEAST_OBJECTS} give an interval.", *more]
        nouns, low, high = NOUNS[row.objects], row.ratio_low, row.ratio_high
        what = f"Over {row.n} {nouns} the ratio of its error to that of {self.rival} is {row.ratio:.3f}"
        what += f", interval {low:.3f} to {high:.3f}"
        if row.verdict == statistics.BELOW:
            few = f", but fewer than {LEAST_SCENARIOS} are too few" * (row.n < LEAST_SCENARIOS)
            return [f"{'Not yet' if few else 'Yes'}. {what}: below 1{few}.", *more]
        if row.verdict == statistics.ABOVE:
            return [f"No. {what}: above 1. A few large errors of {self.rival} make its mean.", *more]
        most = statistics.needed(low, high, row.n)
        would = f"{most} {nouns} that scatter alike would resolve it." if most else "The lead is too small to be resolved."
        return [f"No. {what}: 1 lies in it. {would}", *more]

    def weak(self) -> list[str]:
        """Scenarios in which the best method is weakest, and in which its rival is better; whether it learned anything."""
        said = []
        if len(self.by_scenario) > 1:
            said.append(f"{self.best} is weakest in {self.weakest} ({self.text(self.by_scenario[self.weakest])}).")
        rivals = {name: self.each.get((self.rival, self.task, name)) for name in self.by_scenario}
        worse = [name for name, value in rivals.items() if value is not None and value < self.by_scenario[name]]
        said += [f"{self.rival} is better in {listed(worse, MOST_SAID)}."] if worse else []
        return [*said, f"{self.best} learns nothing, and no method that learns is better."] if self.best in REFERENCES else said

    def others(self) -> list[str]:
        """Other measures of the same frames by which another method is first."""
        first = dict[str, list[str]]()
        usable = self.numbers.usable
        for name in dict.fromkeys(usable.loc[usable["task"] == self.task, "metric"]):
            metric, values = METRICS[str(name)], self.numbers.means(self.task, str(name))
            leader = (max if metric.higher_is_better else min)(values, key=lambda method: values[method])
            if self.best in values and values[leader] != values[self.best]:
                against = f"{metric.heading} ({metric.text(values[leader])} against {metric.text(values[self.best])})"
                first.setdefault(leader, []).append(against)
        return [f"By other measures {leader} is first: {', '.join(found)}." for leader, found in first.items()]

    def causes(self) -> list[tuple[str, str]]:
        """Causes that records name, with the next move, weakest scenario first: perception's warnings there, search, fit."""
        warned = [one for scenario, one in self.numbers.warnings if scenario == self.weakest]
        found = [(f"{self.weakest}: {one.name} ({one.where}).", one.remedy) for one in warned]
        for scenario in self.by_scenario:
            records = self.numbers.everything.records.items()
            own = [record for (place, method, _), record in records if (place, method) == (scenario, self.best)]
            found += [(f"{self.best} on {scenario}: {cause}.", move) for cause, move in causes(own)]
        return found

    def drift(self) -> list[tuple[str, str]]:
        """Sentence on the error of the weakest scenario: there from the start, or growing where the twin predicts."""
        trained = self.each.get((self.best, "reconstruction", self.weakest))
        if self.task != "future" or not trained:
            return []
        numbers = f"{self.text(trained)} on training frames, {self.text(self.by_scenario[self.weakest])} in the future"
        if self.by_scenario[self.weakest] > GROWS * trained:
            cause = f"In {self.weakest} it fits what it saw and drifts after it ({numbers})."
            return [(cause, f"Look in the film of {self.weakest} for the frame in which it drifts, and train on such motion too.")]
        where = f"In {self.weakest} the error is there on training frames already ({numbers})."
        return [(where, f"Look at masks and tracks of {self.weakest} first.")]
