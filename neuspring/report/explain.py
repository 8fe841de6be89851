"""A number of a table -> the runs behind it and their records; a run -> what is known of it.

Everything is read from the file of numbers and from the records on disk, nothing from MLflow.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.artifacts import SAFE_NAME
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.core.table import Table
from neuspring.report.grid import between
from neuspring.report.study import our_change, paper_change
from neuspring.scores.failures import left_out_lines
from neuspring.scores.metrics import DASH, METRICS
from neuspring.scores.numbers import NUMBERS, SUMMARY, Numbers
from neuspring.scores.paper import PAPER_TASKS, Study
from neuspring.scores.runs import one_line
from neuspring.scores.study import StudyNumbers, accounted, verdict_text

SHOWN_FACTS = ("run_key", "source", "commit", "device", "machine", "started", "ended", "data_digest")
MOST_EXPLAINED = 12
"""Runs that are listed."""


@dataclass(frozen=True, kw_only=True)
class Behind:
    """A run behind a cell, counted or left out."""

    scenario: str
    seed: int
    status: str
    why: str
    """The reason why it is left out; empty for a run that counts."""
    record: str
    """Path of run.json."""
    value: float | None = None
    """In the stored unit of the metric."""
    commit: str = ""
    device: str = ""
    problem: str = ""
    """The reason why it is no longer what the table was made of: its record is missing, damaged, failed or that of another run."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A cell of a table and what it is made of."""

    cell: str
    """study/label/task/metric; the study is `numbers.SUMMARY` for the benchmark's own table."""
    row: Mapping[str, Any]
    """The numbers of the cell; None where there is none."""
    runs: Sequence[Behind]
    left_out: Sequence[Behind]
    not_applying: Mapping[str, str]
    """Scenarios to which the method does not apply, so that it has no runs there, and why."""

    @property
    def problems(self) -> list[str]:
        """Runs that count and are no longer what the table was made of."""
        return [f"{run.scenario} / seed {run.seed}: {run.problem}" for run in self.runs if run.problem]

    def as_json(self) -> str:
        """Everything, as JSON text."""
        return json.dumps(asdict(self) | {"problems": self.problems}, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def explain(cell: str, results: Path, folder: Path) -> Explanation:
    """Explain `cell`, STUDY/ROW/TASK/METRIC or METHOD/TASK/METRIC of the numbers in `folder`.

    ROW is a label or a method; tasks and metrics have the paper's names too. Raises InputError for an unknown cell.
    """
    numbers = Numbers.load(folder, results)
    words = [SUMMARY, *cell.split("/")] if cell.count("/") == 2 else cell.split("/")
    if len(words) < 4:
        rule = "a number is METHOD/TASK/METRIC or STUDY/ROW/TASK/METRIC, a run SCENARIO/METHOD/SEED"
        raise InputError(f"cell {cell!r}", rule, cell, "`neuspring explain` lists what there is.")
    studies = {name: one for name, one in numbers.by_study.items() if isinstance(one, StudyNumbers)}
    name = _choose(words[0], {name: name for name in [SUMMARY, *studies]}, "study")
    study, cells, runs = _summary(numbers) if name == SUMMARY else (studies[name].study, studies[name].cells, studies[name].runs)
    labels = {label: label for label in study.rows}
    # Labels may hold a slash.
    label = _choose("/".join(words[1:-2]), {method: label for label, method in study.rows.items()} | labels, "row")
    tasks = {theirs: ours for ours, theirs in PAPER_TASKS.items()} | {task: task for task in cells["task"]}
    task = _choose(words[-2], tasks, "task")
    known = [METRICS[name] for name in dict.fromkeys(cells["metric"])]
    named = {word: one.name for one in known for word in (one.paper_name or one.name, one.heading, one.name)}
    metric = _choose(words[-1], named, "metric")
    found = cells[(cells["label"] == label) & (cells["task"] == task) & (cells["metric"] == metric)].to_dict("records")
    if not found:
        raise InputError(f"cell {cell!r}", "must have a value in the table", "none", "`neuspring explain` lists what there is.")
    row = {str(key): None if isinstance(value, float) and np.isnan(value) else value for key, value in found[0].items()}
    behind = [_behind(run, results, task, metric) for run in runs[runs["label"] == label].to_dict("records")]
    return Explanation(
        cell=f"{name}/{label}/{task}/{metric}",
        row=row,
        runs=[run for run in behind if not run.why],
        left_out=[run for run in behind if run.why],
        not_applying=numbers.everything.left_out.get(str(row["method"]), {}),
    )


def _summary(numbers: Numbers) -> tuple[Study, pd.DataFrame, pd.DataFrame]:
    """The benchmark's own table as a study whose rows are its methods, in the units of tables; and its runs."""
    methods = list(dict.fromkeys(numbers.everything.runs["method"]))
    study = Study(title="Scores", reference=None, baseline=methods[0], rows={name: name for name in methods})
    means = numbers.averages
    factors = means["metric"].map(lambda name: METRICS[name].factor).astype(float) if len(means) else 1.0
    cells = means.assign(label=means["method"], **{name: means[name] * factors for name in ("mean", "other") if name in means})
    return study, cells.rename(columns={"mean": "ours", "other": "other_average"}), accounted(study, numbers.everything)


def _choose(word: str, options: Mapping[str, str], what: str) -> str:
    """The option that `word` names, in any case. Raises InputError with those that are spelled alike."""
    lower = {name.lower(): value for name, value in options.items()}
    if word in options or word.lower() in lower:
        return options.get(word, lower[word.lower()])
    close = difflib.get_close_matches(word, options, n=3, cutoff=0.5)
    remedy = (f"Did you mean {' or '.join(close)}? " if close else "") + f"Known: {', '.join(options)}."
    raise InputError(f"explain, {what}", f"must name a {what}", word, remedy)


def _behind(run: Mapping[Any, Any], results: Path, task: str, metric: str) -> Behind:
    """A run of the file of numbers, as its record is now."""
    path = results / run["scenario"] / run["method"] / str(run["seed"]) / RUN_RECORD
    found: dict[str, Any] = {name: run[name] for name in ("scenario", "seed", "status", "why")} | {"record": str(path)}
    try:
        record = RunRecord.load(path)
        if not record.ok:
            return Behind(**found, problem=f"the run failed: {record.reason}")
        scores = pd.read_parquet(path.parent / str(record.scores_file))
    except (OSError, ValueError) as error:
        return Behind(**found, problem=one_line(error))
    values = scores.loc[(scores["task"] == task) & (scores["metric"] == metric), "value"]
    found |= {"value": float(values.iloc[0]) if len(values) else None, "commit": record.commit, "device": record.device}
    if len(values) or found["why"]:
        other = "another run than the table was made of: make the table again"
        return Behind(**found, problem="" if record.run_key == run["run_key"] else other)
    return Behind(**found | {"why": "no value of this metric (see the notes of its run)"})


def runs_of(word: str, results: Path) -> list[Path]:
    """The records of runs that a word names: a folder, SCENARIO, SCENARIO/METHOD/SEED, or METHOD."""
    word = word.removesuffix(f"/{RUN_RECORD}")
    places = [Path(word), Path(results) / word, *(Path(results).glob(f"*/{word}") if SAFE_NAME.fullmatch(word) else ())]
    return sorted({path for place in places for below in ("", "*/", "*/*/") for path in place.glob(f"{below}{RUN_RECORD}")})


def run_text(path: Path) -> tuple[str, bool]:
    """Facts that the records of a run tell; and True where all are there and the run did not fail."""
    try:
        record = RunRecord.load(path)
        scores = pd.read_parquet(path.parent / record.scores_file) if record.scores_file else pd.DataFrame()
    except (OSError, ValueError) as error:
        return f"{path}: damaged: {one_line(error)}", False
    lines, good = [f"{record.name}: {record.status}{': ' * bool(record.reason)}{record.reason}"], record.ok
    for task, part in scores.groupby("task", sort=False) if len(scores) else ():
        texts = [METRICS[row["metric"]].told(row["value"]) for row in part.to_dict("records")]
        lines.append(f"  {task}: {', '.join(texts)}")
    lines += [f"  note: {note}" for note in record.notes]
    lines += [f"  {name}: {getattr(record, name)}" for name in SHOWN_FACTS]
    for name in record.artifacts.get("records", []):
        try:
            stage = StageRecord.load(path.parent / name)
            lines.append(f"  {stage.stage}: {stage.status}{': ' * bool(stage.reason)}{stage.reason} ({name})")
        except InputError as error:
            good = False
            lines.append(f"  {error}")
    return "\n".join(lines), good


def known(results: Path, folder: Path) -> str:
    """List of what can be explained here."""
    runs = [path.parent.relative_to(results).as_posix() for path in sorted(Path(results).glob(f"*/*/*/{RUN_RECORD}"))]
    if not runs:
        raise InputError(results, "a results folder with finished runs is required", "none", "Name another: --results FOLDER.")
    lines = []
    if (folder / NUMBERS).is_file():
        numbers = Numbers.load(folder, results)
        names = [" | ".join(dict.fromkeys(numbers.averages[column])) for column in ("method", "task", "metric")]
        lines += [f"A number of {folder}/summary.md: METHOD/TASK/METRIC, of\n  " + "\n  ".join(names)] if names[0] else []
        lines += [f"A study: {name}/ROW/TASK/METRIC" for name, one in numbers.by_study.items() if isinstance(one, StudyNumbers)]
    more = [f"and {len(runs) - MOST_EXPLAINED} more"] if len(runs) > MOST_EXPLAINED else []
    return "\n".join([*lines, "A run: " + "\n       ".join([*runs[:MOST_EXPLAINED], *more])])


def text(explanation: Explanation) -> str:
    """The value, the runs behind it and their records, the runs left out, and what is no longer as it was."""
    row, method = explanation.row, explanation.row["method"]
    metric = METRICS[row["metric"]]
    lines = [f"{explanation.cell} (method {method})", "", *_value(row, explanation.cell.startswith(f"{SUMMARY}/")), ""]
    header = ["Scenario", "Seed", "Value", "Commit", "Device", "Record"]
    table = [
        [
            run.scenario,
            str(run.seed),
            metric.text(np.nan if run.value is None else run.value),
            run.commit[:12],
            run.device,
            run.record,
        ]
        for run in explanation.runs
    ]
    lines += [f"{len(table)} runs behind it:", "", *Table.of_texts(header, table).markdown()] if table else ["No run counts."]
    lines += ["", *left_out_lines({str(method): explanation.not_applying})] if explanation.not_applying else []
    left = [f"{run.scenario} / seed {run.seed}: {run.why}" for run in explanation.left_out]
    for title, items in ((f"Left out: {len(left)}", left), ("Not as the table was made of:", explanation.problems)):
        lines += ["", title, "", *(f"- {item}" for item in items)] if items else []
    return "\n".join(lines) + "\n"


def _value(row: Mapping[str, Any], alone: bool) -> list[str]:
    """The number of a cell; unless `alone` the paper's, the verdict, and the change against the baseline."""
    metric, unit = METRICS[row["metric"]], f" {METRICS[row['metric']].shown_unit}".rstrip()
    cell: Any = SimpleNamespace(**{name: np.nan if value is None else value for name, value in row.items()})
    lines = [f"ours     {metric.shown(cell.ours)}{unit}"]
    if np.isfinite(cell.ours):
        weights = "scenarios weigh equally" if metric.average == "equal" else "scenarios weigh by their frames"
        lines = [f"{lines[0]} ({cell.ours!r}): {cell.scenarios} scenarios, {weights}"]
        lines.append(f"         the other average: {metric.shown(cell.other_average)}{unit}")
    if alone:
        return lines
    if np.isfinite(cell.low):
        lines.append(f"         95 % bootstrap interval: {between(cell.low, cell.high, metric.shown)}")
    lines.append(f"paper    {cell.paper or DASH}{unit * bool(cell.paper)}; ours - paper: {metric.shown(cell.difference, '+')}")
    lines.append(f"verdict  {verdict_text(row)}")
    if cell.label != cell.baseline:
        change = f"paper {paper_change(cell, metric)}, ours {our_change(cell, metric)}"
        lines.append(f"change   against {cell.baseline}: {change}: {cell.direction}")
    return lines
