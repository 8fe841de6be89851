"""The answer in words: who wins, whether that is resolved, what went wrong, the probable cause, and the next move.

It stands first on the page, in summary.md and on the terminal, and says only what runs measured and recorded. Next moves are
commands.
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Mapping
from typing import Any, cast

import pandas as pd

from neuspring.baselines import REFERENCES
from neuspring.core.job_records import asked
from neuspring.core.text import listed, program
from neuspring.report.blocks import Block, Code, Text
from neuspring.report.data import several
from neuspring.report.grid import ratio_text
from neuspring.report.notes import causes
from neuspring.scores import statistics
from neuspring.scores.metrics import METRICS
from neuspring.scores.numbers import Numbers
from neuspring.scores.study import LEAST_SCENARIOS

TASK_FRAMES = {"future": "future", "reconstruction": "training"}
NOUNS = {"scenario": "scenarios", "category": "categories"}
"""Objects that intervals of ratios are over."""
MOST_SAID = 3
"""Scenarios, causes and moves that are named."""
GROWS = 2.0
"""A future error of so many times that on training frames is a drift."""
ONE_SEED = "Seeds 0, 1 and 2 would tell how much is chance in training."
TWO_MEASURES = (
    "The two measure different things: track error is how far a few tracked points are, IoU how much of the whole silhouette is "
    "covered, of which a thin object loses nearly all when it lies one width beside its picture."
)
Move = tuple[str, str]
"""Reason and command."""


def verdict(numbers: Numbers) -> list[Block]:
    """Labeled paragraphs on a benchmark, and commands to go on with."""
    runs, about = numbers.collected.runs, asked(numbers.results) if numbers.results else {}
    moves: list[Move] = []
    if (runs["status"] != "ok").any():
        moves.append(("Finish what is missing; what is there is kept:", again(about)))
    if not len(numbers.lead):
        ended = int((runs["status"] == "ok").sum())
        said = {"Who wins": [f"Nothing can be compared yet: {ended} of {len(runs)} runs have finished."]}
        return _paragraphs(said | {"What went wrong": _unfinished(numbers)}, moves)
    duel = Duel(numbers)
    why = [*duel.drift(), *duel.causes()][:MOST_SAID]
    said = {
        "Who wins": duel.winner(),
        "Is it resolved": duel.resolved(),
        "What went wrong": [*_unfinished(numbers), *duel.weak(), *duel.apart(), *duel.others()] or ["No run failed."],
        "Probable cause": why,
    }
    again_with = again(about, "seeds", "[0,1,2]")
    seeds = [("Two more seeds, to tell how much is chance in training:", again_with)] if duel.seeds == 1 else []
    # Seeds tell nothing of other scenes: with one, looking comes first.
    order = [*seeds, *duel.looks()] if duel.scenarios > 1 else [*duel.looks(), *seeds]
    return _paragraphs(said, [*moves, *order])


def again(about: Mapping[str, Any], key: str = "", value: str = "") -> str:
    """The command of the last run of the workflow, with one setting changed; empty where that run is not known."""
    words = [word for word in about.get("command", ()) if not key or not word.startswith(f"{key}=")]
    if words and key:
        place = next((k + 1 for k, word in enumerate(words) if word in ("--config", "-C")), None)
        words[len(words) if place is None else place : place] = [*["--config"] * (place is None), f"{key}={value}"]
    return shlex.join(words)


def headline(summary: str) -> str:
    """The first table of a summary in Markdown, with the lines above it but not the heading: what a terminal shows."""
    before, bar, rest = summary.partition("\n|")
    rows = "".join(itertools.takewhile(lambda line: line.startswith("|"), (bar[1:] + rest).splitlines(keepends=True)))
    lines = [line for line in before.replace("**", "").splitlines() if not line.startswith(("#", "```"))]
    return re.sub(r"\n{3,}", "\n\n", "\n".join([*lines, "", rows])).strip()


def _paragraphs(said: Mapping[str, list[str]], moves: list[Move]) -> list[Block]:
    blocks: list[Block] = [Text(label=label, text=" ".join(sentences)) for label, sentences in said.items() if sentences]
    for reason, command in [move for move in moves if move[1]][:MOST_SAID]:
        first = not any(isinstance(block, Code) for block in blocks)
        blocks += [Text(label="Next move" if first else "Or", text=reason), Code(text=command, whole=True)]
    return blocks


def _unfinished(numbers: Numbers) -> list[str]:
    """Runs that were left out on purpose, failed runs with the first reason, and how many runs have not finished."""
    runs = numbers.collected.runs
    failed, missing = runs[runs["status"] == "failed"], int((runs["status"] == "missing").sum())
    said = [f"As asked: {numbers.asked}; no other runs were made."] if numbers.asked else []
    said += [f"{missing} of {len(runs)} runs have not finished."] if missing else []
    if len(failed):
        first = failed.iloc[0]
        where = f"{numbers.name(first['method'])} on {first['scenario']}"
        said.append(f"{len(failed)} of {len(runs)} runs failed, first {where}: {first['reason']}.")
    return said


class Duel:
    """The words on `Numbers.lead`: the best method by the error that decides, and its rival."""

    def __init__(self, numbers: Numbers) -> None:
        self.numbers, self.lead = numbers, cast("Any", next(numbers.lead.itertuples()))
        self.method, self.task, self.metric = str(self.lead.best), str(self.lead.task), METRICS[str(self.lead.metric)]
        self.best, self.rival = (numbers.name(str(name)) for name in (self.lead.best, self.lead.rival))
        usable, finished = numbers.usable, numbers.finished[numbers.finished["metric"] == self.metric.name]
        part = usable[(usable["task"] == self.task) & (usable["metric"] == self.metric.name)]
        self.scenarios, self.seeds = part["scenario"].nunique(), part["seed"].nunique()
        each: Any = finished.groupby(["method", "task", "scenario"])["value"].mean().to_dict()
        self.each: dict[tuple[str, str, str], float] = each
        own = {scenario: value for (method, at, scenario), value in self.each.items() if (method, at) == (self.method, self.task)}
        self.by_scenario = dict(sorted(own.items(), key=lambda pair: -pair[1]))
        self.weakest = next(iter(self.by_scenario))
        row = self.lead
        self.ahead = row.verdict == (statistics.BELOW if row.method == self.method else statistics.ABOVE)

    def text(self, value: float) -> str:
        """An error with its unit."""
        return f"{self.metric.text(value)} {self.metric.shown_unit}"

    def winner(self) -> list[str]:
        """Who is ahead, and the one number of the pair."""
        what, row = f"{self.metric.title} on {TASK_FRAMES[self.task]} frames", self.lead
        if not self.rival:
            mean = self.numbers.means(self.task, self.metric.name)[self.method]
            return [f"{self.best} is alone: its {what} is {self.text(mean)}."]
        size = f"({several(self.scenarios, 'scene')}, {several(self.seeds, 'seed')})"
        said = [f"{self.best} is ahead of {self.rival} {size}." if self.ahead else f"No method is ahead {size}."]
        if pd.notna(row.ratio):
            ends, nouns = " and 95 % interval" * pd.notna(row.ratio_low), NOUNS[row.objects] if row.n > 1 else row.objects
            method, base = (self.numbers.name(str(name)) for name in (row.method, row.baseline))
            said.append(
                f"The {what} of {method} is {ratio_text(row)} times that of {base} (geometric mean{ends} over {row.n} {nouns})."
            )
        return said

    def resolved(self) -> list[str]:
        """The answer to: is the lead over the rival more than chance, and what would show it if not?"""
        if not self.rival:
            return []
        row, more = self.lead, [ONE_SEED] if self.seeds == 1 else []
        if row.verdict == statistics.TOO_FEW:
            count = several(self.scenarios, "scenario")
            return [f"No. {count} cannot tell a lead from chance; {statistics.LEAST_OBJECTS} give an interval.", *more]
        nouns = NOUNS[row.objects]
        if self.ahead:
            few = f", but fewer than {LEAST_SCENARIOS} {nouns} are too few" * (row.n < LEAST_SCENARIOS)
            return [f"{'Not yet' if few else 'Yes'}. 1 lies outside the interval{few}.", *more]
        if row.verdict != statistics.NOT_RESOLVED:
            return ["No. The interval lies on the other side of 1 over the runs that both finished.", *more]
        most = statistics.needed(row.ratio_low, row.ratio_high, row.n)
        would = f"{most} {nouns} that scatter alike would resolve it." if most else "The lead is too small to be resolved."
        return [f"No. 1 lies in the interval. {would}", *more]

    def weak(self) -> list[str]:
        """Scenarios in which the best method is weakest, and in which its rival is better; whether it learned anything."""
        said = []
        if len(self.by_scenario) > 1:
            said.append(f"{self.best} is weakest in {self.weakest} ({self.text(self.by_scenario[self.weakest])}).")
        better, worse = list[str](), list[str]()
        for name, own in self.by_scenario.items():
            theirs = self.each.get((str(self.lead.rival), self.task, name))
            if theirs is not None and self.text(theirs) != self.text(own):
                (better if theirs < own else worse).append(f"{name} ({self.metric.text(theirs)} against {self.text(own)})")
        if better:
            behind = f"; it is worse in {listed(worse, MOST_SAID)}" if worse else ""
            said.append(f"{self.rival} is better in {listed(better, MOST_SAID)}{behind}.")
        return [*said, f"{self.best} learns nothing, and no method that learns is better."] if self.method in REFERENCES else said

    def apart(self) -> list[str]:
        """Scenarios in which the method of the best track error has the worst IoU, with the reason."""
        finished, found = self.numbers.finished, []
        for scenario, part in finished[finished["task"] == self.task].groupby("scenario", sort=False):
            table = part.pivot_table(index="method", columns="metric", values="value")
            table = table.dropna() if {"track_error", "iou"} <= set(table) else table[:0]
            if len(table) and table["track_error"].idxmin() == table["iou"].idxmin() and table["iou"].nunique() > 1:
                best = str(table["track_error"].idxmin())
                values = " and ".join(METRICS[name].told(float(table[name].min())) for name in ("track_error", "iou"))
                found.append(f"{self.numbers.name(best)} in {scenario} ({values})")
        return [f"The best track error goes with the worst IoU: {listed(found, MOST_SAID)}. {TWO_MEASURES}"] if found else []

    def others(self) -> list[str]:
        """Other measures of the same frames by which another method is first."""
        first = dict[str, list[str]]()
        usable = self.numbers.usable
        for name in dict.fromkeys(usable.loc[usable["task"] == self.task, "metric"]):
            metric, values = METRICS[str(name)], self.numbers.means(self.task, str(name))
            leader = (max if metric.higher_is_better else min)(values, key=lambda method: values[method])
            if self.method in values and values[leader] != values[self.method]:
                mean = "mean " * (name == self.metric.name)
                against = f"{mean}{metric.heading} ({metric.text(values[leader])} against {metric.text(values[self.method])})"
                first.setdefault(self.numbers.name(leader), []).append(against)
        told = [f"{leader} in {', '.join(found)}" for leader, found in first.items()]
        return [f"First by other measures: {'; '.join(told)}."] if told else []

    def causes(self) -> list[str]:
        """Causes that records name, with what to change, weakest scenario first: perception's warnings there, search, fit."""
        warned = [one for scenario, one in self.numbers.warnings if scenario == self.weakest]
        found = [f"{self.weakest}: {one.name} ({one.where}). {one.remedy}".rstrip() for one in warned]
        for scenario in self.by_scenario:
            records = self.numbers.everything.records.items()
            own = [record for (place, method, _), record in records if (place, method) == (scenario, self.method)]
            found += [f"{self.best} on {scenario}: {cause}. {move}" for cause, move in causes(own)]
        return found

    def looks(self) -> list[Move]:
        """The command that shows the weakest scenario; none where no folder holds its runs."""
        results, methods = self.numbers.results, dict.fromkeys([self.method, str(self.lead.rival)])
        found = [sorted(results.glob(f"{self.weakest}/{name}/*/run.json"))[:1] for name in methods if name] if results else []
        runs = [str(path.parent) for paths in found for path in paths]
        where = f"Look where {self.weakest} goes wrong:" if self.scenarios > 1 else f"Look at {self.weakest}:"
        return [(where, shlex.join([program("neuspring"), "play", *runs]))] if runs else []

    def drift(self) -> list[str]:
        """Sentence on the error of the weakest scenario: there from the start, or growing where the twin predicts."""
        trained = self.each.get((self.method, "reconstruction", self.weakest))
        if self.task != "future" or not trained:
            return []
        numbers = f"{self.text(trained)} on training frames, {self.text(self.by_scenario[self.weakest])} in the future"
        if self.by_scenario[self.weakest] > GROWS * trained:
            return [f"In {self.weakest} it fits what it saw and drifts after it ({numbers})."]
        return [f"In {self.weakest} the error is there on training frames already ({numbers})."]
