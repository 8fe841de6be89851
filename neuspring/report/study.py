"""The tables of a study beside the paper's: CSV, Markdown and LaTeX from run records, and blocks of the report.

Per study, in one folder: <study>.md and .tex (to read), .csv (a row per cell), _runs.csv (which runs count, and why not the
others), _failures.csv (averages without and with failed runs), _scenarios.csv, _categories.csv, .json (what the table was made
of, for `neuspring explain`); where the released PhysTwin's method is a row, and its scenarios are among the runs, also
_released_phystwin.csv and .md; for the number of regions _curve.png.

Tables have the paper's layout: both tasks side by side, the best marked.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from neuspring.config import parse
from neuspring.config.parse import STRICT, Name
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json
from neuspring.core.table import LATEX_PREAMBLE, Cell, Chip, Table, Tone
from neuspring.report import study_cells
from neuspring.report.benchmark import failure_table
from neuspring.report.blocks import Block, Fold, Items, Text, markdown
from neuspring.report.draw.benchmark import cluster_methods, clusters_figure
from neuspring.report.draw.sheet import save
from neuspring.report.notes import differing_table
from neuspring.report.study_cells import (
    BETTER,
    CONFIRMED,
    LEAST_SCENARIOS,
    OPPOSITE,
    ORACLE_LINE,
    WITHIN,
    WORSE,
    accounted,
    cells,
    counted,
    in_order,
    restricted,
)
from neuspring.report.study_clips import read_clips, write_clips
from neuspring.scores import paper
from neuspring.scores.failures import (
    DASHES,
    NOTHING,
    WHY,
    LeftOut,
    both_averages,
    left_out_lines,
    removed_lines,
    unknown_lines,
)
from neuspring.scores.metrics import DASH, IN_PAPER, IN_STUDIES, SHORT, Metric, averages, present
from neuspring.scores.paper import Study
from neuspring.scores.runs import Collected, collect, mixed_settings, pairs

RELEASED_METHODS = ("phystwin", "baseline")
"""Our methods that stand for the released PhysTwin."""
VERDICTS = (
    "Verdict: within, the paper's value lies in the 95 % bootstrap interval of our mean, half a unit of its last digit allowed; "
    "better, worse: outside; partial: fewer than its 22 scenarios count; other data: these are other scenarios, whose values "
    "cannot be compared with the paper's."
)
DIRECTIONS = (
    "Verdict: same direction, confirmed: our interval leaves out 0 on the paper's side; opposite: on the other side; not resolved: "
    f"it holds 0; better, worse: it leaves out 0, and the paper has no number; too few scenarios: fewer than {LEAST_SCENARIOS}, "
    "which too often change in one direction by chance."
)
NAMED = 6
"""At most so many runs with the same reason are named. <study>_runs.csv has all."""
FAILED_MARK = "*"
"""Stands beside the number of runs of a method if some of them failed."""
SIGNS: dict[str, tuple[Tone, str]] = {
    WITHIN: ("good", "✓"),
    BETTER: ("good", "▲"),
    WORSE: ("bad", "▼"),
    CONFIRMED: ("good", "✓"),
    OPPOSITE: ("bad", "✗"),
    study_cells.NO_INTERVAL: ("warn", "~"),
    study_cells.NOT_RESOLVED: ("warn", "~"),
    study_cells.TOO_FEW: ("", "~"),
    study_cells.OTHER_DATA: ("", "◇"),
    study_cells.NOT_RUN: ("mute", "○"),
}
"""Verdict to tone and symbol. All others are muted."""
Columns = list[tuple[str, Metric]]
"""Tasks and metrics."""
Mark = Literal["", "best", "second"]


@dataclass(frozen=True, kw_only=True)
class StudyRecord:
    """The runs that a study's table was made of."""

    __pydantic_config__ = STRICT
    name: Name
    study: Study
    scenarios: tuple[Name, ...]
    methods: tuple[Name, ...]
    """The methods of the study that the benchmark has."""
    seeds: tuple[int, ...]
    left_out: dict[Name, tuple[Name, ...]] = field(default_factory=dict)
    """Method to the scenarios to which it does not apply."""

    def save(self, folder: Path) -> None:
        """Write <name>.json."""
        text = json.dumps({"format": RECORD_FORMAT, **dataclasses.asdict(self)}, indent=1, ensure_ascii=False)
        write_text(folder / f"{self.name}.json", text + "\n")

    @classmethod
    def load(cls, path: Path) -> StudyRecord:
        """Read <name>.json. Raises InputError."""
        return parse(cls, read_json(path, RECORD_FORMAT), str(path))


@dataclass(frozen=True, kw_only=True)
class StudyNumbers:
    """A study with its runs; what tables show of them is computed once."""

    name: str
    study: Study
    collected: Collected
    """With runs of other methods, which are ignored."""
    beside: Study | None = None
    """The study that is shown next to this one."""

    @cached_property
    def own(self) -> Collected:
        """The runs of the study's methods, scores in the paper's units."""
        return restricted(self.study, self.collected)

    @cached_property
    def counted(self) -> pd.DataFrame:
        """The scores that averages take."""
        return counted(self.own)

    @cached_property
    def cells(self) -> pd.DataFrame:
        """A row per label, task and metric (`study_cells.cells`)."""
        return cells(self.study, self.own)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Every run, whether it counts, and why not."""
        return accounted(self.study, self.own)

    @cached_property
    def means(self) -> pd.DataFrame:
        """Averages without and with failed runs."""
        return both_averages(*self.own.comparison.parts)

    @cached_property
    def scenarios(self) -> pd.DataFrame:
        """Values per scenario, of all finished runs."""
        return by_scenario(self.study, self.own, self.runs)

    @cached_property
    def categories(self) -> pd.DataFrame:
        """Values per category, of the runs that count."""
        return by_category(self.study, self.counted)

    @property
    def labels(self) -> dict[str, str]:
        """Method to label."""
        return _labels(self.study)


def write_study(
    name: str,
    study: Study,
    results: Path,
    scenarios: Sequence[str],
    seeds: Sequence[int],
    known_methods: Iterable[str],
    folder: Path,
    left_out: LeftOut = NOTHING,
    beside: Study | None = None,
) -> str:
    """Write all files of a study; returns the Markdown. Rows whose method is not among `known_methods` are "not run".

    `left_out` maps a method to the scenarios to which it does not apply. `beside` is the study that is shown next to this one.
    """
    if study.clips:
        return write_clips(name, read_clips(study, results, scenarios, seeds, set(known_methods)), folder)
    benchmark, shown = set(known_methods), [*study.rows.values(), *(beside.rows.values() if beside else ())]
    methods = [method for method in dict.fromkeys(shown) if method in benchmark]
    return write_collected(name, study, collect(results, scenarios, methods, seeds, left_out), folder, beside)


def write_collected(name: str, study: Study, collected: Collected, folder: Path, beside: Study | None = None) -> str:
    """As `write_study`, from runs that are read already. Methods of other studies are ignored."""
    if study.clips:
        remedy = "Leave out --scores; name --results, --scenarios, --methods and --seeds."
        raise InputError(f"study {name}", "a study of clips needs the transfers of a results folder", "scores alone", remedy)
    numbers = StudyNumbers(name=name, study=study, collected=collected, beside=beside)
    own = numbers.own
    files = {"": numbers.cells.assign(study=name), "_runs": numbers.runs, "_scenarios": numbers.scenarios}
    files |= {"_categories": numbers.categories, "_failures": numbers.means}
    for suffix, rows in files.items():
        write_text(folder / f"{name}{suffix}.csv", rows.to_csv(index=False))
    names = {column: tuple(dict.fromkeys(own.runs[column].tolist())) for column in ("scenario", "method", "seed")}
    absent = {method: tuple(where) for method, where in own.left_out.items()}
    methods = tuple(dict.fromkeys([*names["method"], *absent]))
    record = StudyRecord(name=name, study=study, scenarios=names["scenario"], methods=methods, seeds=names["seed"], left_out=absent)
    record.save(folder)
    tables = study_tables(numbers)
    footnote = differing_table(own.records.values(), numbers.labels)
    floats = [table.latex(f"{name}-{index + 1}", f"{study.title}: {table.caption}") for index, table in enumerate(tables)]
    floats += [table.latex(f"{name}-settings", f"{study.title}: settings that differ") for table in footnote]
    write_text(folder / f"{name}.tex", "\n".join([LATEX_PREAMBLE, *floats]))
    warning = mixed_settings(own.runs)
    before: list[Block] = [Text(text=warning, tone="warn")] if warning else []
    parts = [f"# {study.title}\n", markdown([*before, *tables, *footnote])]
    parts.append(_curve(numbers, folder / f"{name}_curve.png"))
    parts.append(markdown([*left_out_items(numbers), *value_tables(numbers)]))
    parts.append(_write_released(numbers, folder))
    text = "\n".join(part for part in parts if part)
    write_text(folder / f"{name}.md", text)
    return text


def study_blocks(numbers: StudyNumbers) -> list[Block]:
    """What the report shows of a study: the same tables."""
    first, *others = study_tables(numbers)
    rest: list[Block] = [Fold(summary=table.caption, blocks=[table], open=False) for table in others]
    last = [*differing_table(numbers.own.records.values(), numbers.labels), *left_out_items(numbers), *value_tables(numbers)]
    return (
        [first, *rest, Fold(summary="Settings, runs that do not count, categories and scenarios", blocks=last)]
        if last
        else [first, *rest]
    )


def study_tables(numbers: StudyNumbers) -> list[Table]:
    """The tables that have rows. The note of the first one explains averages and verdicts."""
    study, own, table = numbers.study, numbers.own, numbers.cells
    kept = pairs(numbers.counted)
    beyond = table[~table["metric"].isin(list(IN_PAPER))] if study.reference else table[:0]
    table = table.drop(beyond.index)
    which = f"Averages take the {kept} of {pairs(own.runs)} pairs of scenario and seed "
    which += "that every method with a finished run has finished."
    finished = (own.runs["status"] == "ok").any()
    nothing = "No pair of scenario and seed was finished by every method." if finished else "Nothing has finished."
    removed = " ".join(removed_lines(own.comparison.runs, own.left_out, numbers.labels))
    notes = [VERDICTS if study.reference else "", which if kept else nothing, removed, _pictures(own)]
    notes += [paper.CLUSTER_CLAIM] if cluster_methods(study.rows.values()) else []
    tables = [
        main_table(study, table, " ".join(note for note in notes if note)),
        beyond_table(study, beyond),
        study_failures(numbers),
        interval_table(table),
        change_table(study, table),
        _values_table(
            "The other average",
            "Ours in the other average: CD and TE weighted by frames, pictures with equal weights of scenarios.",
            ["Method"],
            table[table["ours"].notna()].assign(value=table["other_average"]),
            ["label"],
        ),
    ]
    if numbers.beside:
        tables += both_trainings(
            study, numbers.cells, numbers.beside, cells(numbers.beside, restricted(numbers.beside, numbers.collected))
        )
    return [table for table in tables if table.rows]


def value_tables(numbers: StudyNumbers) -> list[Table]:
    """Ours per category and per scenario."""
    parts = [
        ("Per category", "Ours, in the average that the paper takes.", ["Category", "Method"], numbers.categories, "category"),
        ("Per scenario", "Ours, all finished runs, seeds averaged.", ["Scenario", "Method"], numbers.scenarios, "scenario"),
    ]
    return [_values_table(title, note, stub, table, [key, "label"]) for title, note, stub, table, key in parts if len(table)]


def _grouped(caption: str, note: str, stub: list[str], columns: Columns, rows: list[list[Cell]]) -> Table:
    """A table whose columns behind the stub are tasks and metrics."""
    header, groups = [*stub, *(metric.paper_column for _, metric in columns)], [SHORT[task] for task, _ in columns]
    return Table(caption=caption, note=note, header=header, groups=groups, stub=len(stub), rows=rows)


def main_table(study: Study, cells: pd.DataFrame, more: str = "") -> Table:
    """The paper's table with ours and the verdict below every row. `more` is added to the note."""
    columns = _columns(cells)
    marks = {source: _marks(study, cells, columns, source) for source in ("paper", "ours")}
    rows: list[list[Cell]] = []
    for label, part in _rows(cells[~cells["oracle"]]):
        printed, ours, verdicts = [], [], []
        for task, metric in columns:
            cell, key = part[task, metric.name], (label, task, metric.name)
            printed.append(Cell(text=cell.paper or DASH, mark=marks["paper"].get(key, "")))
            ours.append(Cell(text=_ours(cell, metric), mark=marks["ours"].get(key, "")))
            verdicts.append(Cell(chips=[verdict_chip(cell.verdict)]))
        if study.reference:
            rows.append([Cell(text=label), Cell(), Cell(text="paper"), *printed])
        rows.append([Cell(text="" if study.reference else label), Cell(text=_runs(cell)), Cell(text="ours"), *ours])
        if study.reference:
            rows.append([Cell(), Cell(), Cell(text="verdict"), *verdicts])
    rows += _oracle_rows(cells, columns, 3)
    note = (
        f"{_units(columns)} Ours: mean over scenarios, seeds averaged within each, ± standard deviation over seeds"
        f"{_conventions(columns)}."
    )
    if cells["failed"].any():
        note += f" {FAILED_MARK} Some runs failed; the table of failures has both averages, without and with them."
    caption = "Ours beside the paper's" if study.reference else "Ours"
    return _grouped(caption, f"{note} {more}".rstrip(), ["Method", "Runs", ""], columns, rows)


def _oracle_rows(cells: pd.DataFrame, columns: Columns, stub: int) -> list[list[Cell]]:
    """A row that says what oracles are, then theirs; never marked."""
    rows: list[list[Cell]] = []
    for label, part in _rows(cells[cells["oracle"]]):
        values = [Cell(text=metric.paper_text(part[task, metric.name].ours)) for task, metric in columns]
        rows += [] if rows else [[Cell(text=ORACLE_LINE), *[Cell()] * (stub - 1 + len(columns))]]
        rows.append([Cell(text=label), *[Cell()] * (stub - 2), Cell(text="ours"), *values])
    return rows


def _lines(
    cells: pd.DataFrame, columns: Columns, lines: Callable[[str], Sequence[tuple[str, Callable[[Any, Metric], Cell]]]]
) -> list[list[Cell]]:
    """Rows of every label: `lines` of it are their names and what they show of a cell; a dash where there is no cell."""
    rows: list[list[Cell]] = []
    for label, part in _rows(cells):
        for index, (name, show) in enumerate(lines(label)):
            here = [(part.get((task, metric.name)), metric) for task, metric in columns]
            values = [show(cell, metric) if cell else Cell(text=DASH) for cell, metric in here]
            rows.append([Cell(text="" if index else label), Cell(text=name), *values])
    return rows


def _ours_cell(cell: Any, metric: Metric) -> Cell:
    return Cell(text=_ours(cell, metric))


def _interval_cell(cell: Any, metric: Metric) -> Cell:
    return Cell(text=_interval(cell.low, cell.high, metric.paper_text) or DASH)


def _change_cell(cell: Any, metric: Metric) -> Cell:
    return Cell(text=our_change(cell, metric))


def _direction_cell(cell: Any, _: Metric) -> Cell:
    return Cell(chips=[verdict_chip(cell.direction)])


def beyond_table(study: Study, cells: pd.DataFrame) -> Table:
    """Metrics that the paper does not have: ours, its interval, the change against the baseline and its verdict."""
    values = [("ours", _ours_cell), ("95 %", _interval_cell)]
    changes = [("change", _change_cell), ("verdict", _direction_cell)]
    columns = _columns(cells)
    rows = _lines(cells[~cells["oracle"]], columns, lambda label: values + (changes if label != study.baseline else []))
    rows += _oracle_rows(cells, columns, 2)
    note = (
        "TE bound: track error, in mm, of points that move with the nodes around them. It is 0 for every rigid motion. TE has "
        f"a floor, its value in frame 0. Change against {study.baseline} with the paired 95 % bootstrap interval."
    )
    return _grouped("Without a floor", note, ["Method", ""], columns, rows)


def both_trainings(study: Study, cells: pd.DataFrame, beside: Study, others: pd.DataFrame) -> list[Table]:
    """Two studies of the same labels under one heading: values, and changes against the baseline of the same training."""
    blocks = [(beside, others), (study, cells)]
    finished = [table[table["ours"].notna()] for _, table in blocks if len(table)]
    columns = in_order({(task, metric.name) for table in finished for task, metric in _columns(table)})
    by_label = [dict(_rows(table[~table["oracle"]])) for _, table in blocks]
    values, changes = list[list[Cell]](), list[list[Cell]]()
    for label in (label for label in study.rows if label in by_label[0] and label in by_label[1]):
        for number, (block, rows) in enumerate(zip(blocks, by_label, strict=True)):
            here = [(rows[label].get((task, metric.name)), metric) for task, metric in columns]
            stub = [Cell(text="" if number else label), Cell(text=block[0].training)]
            values.append([*stub, *(Cell(text=_ours(cell, metric) if cell else DASH) for cell, metric in here)])
            if label != block[0].baseline:
                changes.append([*stub, *(Cell(text=our_change(cell, metric) if cell else DASH) for cell, metric in here)])
    note = "The same rows in two trainings. Each is averaged over the scenarios and seeds that all its rows finished."
    against = f"{note} Against {study.baseline} of the same training, with the paired 95 % bootstrap interval."
    tables = [("Both trainings", note, values), ("Both trainings: change", against, changes)]
    return [_grouped(title, text, ["Method", "Training"], columns, rows) for title, text, rows in tables if columns]


def interval_table(cells: pd.DataFrame) -> Table:
    """The interval of our mean, and its distance from the paper's value, of finished rows."""
    finished = cells[cells["ours"].notna()]
    compared = bool(finished["difference"].notna().any())
    lines = [("95 %", _interval_cell)]
    if compared:
        lines.append(("ours - paper", lambda cell, metric: Cell(text=metric.paper_text(cell.difference, "+"))))
    note = f"95 % bootstrap interval of our mean, over scenarios and seeds{'; ours minus the value of the paper' * compared}."
    columns = _columns(finished)
    return _grouped("Intervals", note, ["Method", ""], columns, _lines(finished, columns, lambda _: lines))


def change_table(study: Study, cells: pd.DataFrame) -> Table:
    """The change against the baseline, in the paper and here."""
    columns = _columns(cells)
    others = cells[~cells["oracle"] & (cells["label"] != study.baseline)]
    printed = set(others.loc[np.isfinite(others["paper_change"].astype(float)), "label"])
    of_paper = [("paper", lambda cell, metric: Cell(text=paper_change(cell, metric)))]
    ours = [("ours", _change_cell), ("verdict", _direction_cell)]
    rows = _lines(others, columns, lambda label: of_paper + ours if label in printed else ours)
    in_db = " (PSNR: in dB)" if any(not metric.relative for _, metric in columns) else ""
    note = (
        f"Change against {study.baseline} on the same scenarios and seeds, in per cent of its mean{in_db}, with the paired 95 % "
        f"bootstrap interval. {DIRECTIONS}"
    )
    return _grouped(f"Change against {study.baseline}", note, ["Method", ""], columns, rows)


def study_failures(numbers: StudyNumbers) -> Table:
    """Rows whose method failed somewhere: both averages (`failures.both_averages`), weighted as the paper does."""
    means = numbers.means
    failed = means[means["succeeded"] < means["attempted"]]
    columns = in_order(present(failed.dropna(subset="metric")))

    def cell(row: Any, name: str) -> Cell:
        metric = IN_STUDIES[row["metric"]]
        return Cell(text=metric.paper_text(float(row[name if metric.average == "equal" else f"{name}_frames"])))

    labels = {method: label for label, method in numbers.study.rows.items()}
    table = failure_table("Failures", failed, labels, [(task, metric.name) for task, metric in columns], cell)
    note = " ".join([f"Rows marked {FAILED_MARK} above. {WHY} {DASHES}", *unknown_lines(means, labels)])
    return _grouped(table.caption, note, list(table.header), columns, [list(row) for row in table.rows])


def _values_table(title: str, note: str, stub: list[str], table: pd.DataFrame, keys: list[str]) -> Table:
    """Any table of ours in long form (task, metric, value and `keys`), one line per combination of keys."""
    columns, rows = in_order(present(table)), list[list[Cell]]()
    for names, part in table.groupby(keys, sort=False):
        values = part.set_index(["task", "metric"])["value"].to_dict()
        texts = [metric.paper_text(values.get((task, metric.name), np.nan)) for task, metric in columns]
        rows.append([Cell(text=str(text)) for text in (*names, *texts)])
    return _grouped(title, note, stub, columns, rows)


def our_change(cell: Any, metric: Metric) -> str:
    """The change against the baseline and its interval, in per cent where that means something."""
    if metric.relative and np.isfinite(cell.relative):
        return f"{_percent(cell.relative)} % {_interval(cell.relative_low, cell.relative_high, _percent)}".rstrip()
    if np.isnan(cell.change):
        return DASH
    interval = _interval(cell.change_low, cell.change_high, lambda value: metric.paper_text(value, "+"))
    return f"{metric.paper_text(cell.change, '+')} {interval}".rstrip()


def paper_change(cell: Any, metric: Metric) -> str:
    """The change against the baseline that the paper prints, rounded as it is."""
    if np.isnan(cell.paper_change):
        return DASH
    return f"{_percent(cell.paper_relative)} %" if metric.relative else metric.paper_text(cell.paper_change, "+")


def verdict_chip(name: str, text: str = "") -> Chip:
    """A verdict in its color."""
    tone, symbol = SIGNS.get(kind(name), ("mute", "○"))
    return Chip(text=text or name, tone=tone, symbol=symbol)


def kind(verdict: str) -> str:
    """The verdict without the count of scenarios or failures that it depends on."""
    return re.sub(r" \(\d+ failed\)$", "", re.sub(r"^partial \([^)]*\): ", "", verdict))


def _ours(cell: Any, metric: Metric) -> str:
    return metric.paper_text(cell.ours) + (f" ± {metric.paper_text(cell.spread)}" if np.isfinite(cell.spread) else "")


def _interval(low: float, high: float, show: Callable[[float], str]) -> str:
    return f"[{show(low)}, {show(high)}]" if np.isfinite(low) else ""


def _percent(value: float) -> str:
    return f"{100 * value:+.1f}"


def _columns(cells: pd.DataFrame) -> Columns:
    pairs = dict.fromkeys(zip(cells["task"], cells["metric"], strict=True))
    return [(str(task), IN_STUDIES[str(metric)]) for task, metric in pairs]


def _rows(cells: pd.DataFrame) -> Iterable[tuple[str, dict[tuple[str, str], Any]]]:
    for label, part in cells.groupby("label", sort=False):
        yield str(label), {(str(cell.task), str(cell.metric)): cell for cell in part.itertuples()}


def _runs(cell: Any) -> str:
    total = cell.ok + cell.failed + cell.missing
    wrong = ", ".join(f"{count} {name}" for name, count in (("failed", cell.failed), ("missing", cell.missing)) if count)
    mark = f" {FAILED_MARK}" if cell.failed else ""
    return f"{cell.ok}/{total}" + (f" ({wrong})" if wrong else "") + mark if total else DASH


def _units(columns: Columns) -> str:
    text = "CD (single-directional L1 Chamfer distance) and TE (track error) in mm"
    return f"{text}, PSNR in dB." if any(metric.name == "psnr" for _, metric in columns) else f"{text}."


def _conventions(columns: Columns) -> str:
    if not any(metric.average == "frames" for _, metric in columns):
        return ""
    return "; as the paper does, CD and TE weigh scenarios equally, scores of pictures weigh them by their frames"


def _marks(study: Study, cells: pd.DataFrame, columns: Columns, source: str) -> dict[tuple[str, str, str], Mark]:
    """Best and, where the paper marks it, second best of every column, as far as the printed digits tell."""
    marks: dict[tuple[str, str, str], Mark] = {}
    for task, metric in columns:
        part = cells[(cells["task"] == task) & (cells["metric"] == metric.name) & ~cells["oracle"]]
        values = pd.to_numeric(part[source]).round(metric.paper_digits)
        ranked = sorted(values.dropna().unique(), reverse=metric.higher_is_better)
        if values.notna().sum() < 2:
            continue
        names: tuple[Mark, ...] = ("best", "second") if study.reference in paper.UNDERLINED else ("best",)
        for label, value in zip(part["label"], values, strict=True):
            mark = dict(zip(ranked, names, strict=False)).get(value)
            if mark:
                marks[label, task, metric.name] = mark
    return marks


def by_scenario(study: Study, own: Collected, runs: pd.DataFrame) -> pd.DataFrame:
    """A row per scenario, row label, task and metric: mean and spread over the finished seeds, and how many of them count."""
    keys = ["scenario", "category", "label", "method", "task", "metric"]
    finished = own.scores.merge(runs.loc[runs["status"] == "ok", ["label", "scenario", "method", "seed", "counted"]])
    table = finished.groupby(keys, sort=False).agg(
        value=("value", "mean"),
        spread=("value", "std"),
        seeds=("seed", "nunique"),
        counted=("counted", "sum"),
        frames=("frames", "mean"),
    )
    return _in_order(study, table.reset_index())


def by_category(study: Study, scores: pd.DataFrame) -> pd.DataFrame:
    """A row per category, row label, task and metric: `value` in the average that the paper takes, and both averages."""
    labels = _labels(study)
    columns = ["category", "label", "method", "task", "metric", "value", "equal", "frames", "seed_std", "scenarios"]
    if not len(scores):
        return pd.DataFrame(columns=[*columns, "unit"])
    table = averages(scores, by=("category", "method", "task", "metric"))
    frames = table["metric"].map({name: metric.average == "frames" for name, metric in IN_STUDIES.items()})
    table = table.assign(label=table["method"].map(labels), value=np.where(frames, table["frames"], table["equal"]))
    return _in_order(study, table[columns])


def released_comparison(own: Collected, method: str) -> pd.DataFrame:
    """Every value of the released PhysTwin with ours beside it, mm; NaN where there is no finished run on the released data."""
    mine = (own.runs["status"] == "ok") & (own.runs["source"] == "phystwin") & (own.runs["method"] == method)
    finished = own.runs.loc[mine, ["scenario", "method", "seed"]]
    keys = ["scenario", "task", "metric"]
    ours = own.scores.merge(finished).groupby(keys)["value"].agg(ours="mean", spread="std", seeds="count").reset_index()
    released = paper.released().assign(released=1e3 * paper.released()["value"]).drop(columns="value")
    table = released.merge(ours, on=keys, how="left")
    table["seeds"] = table["seeds"].fillna(0).astype(int)
    return table.assign(difference=table["ours"] - table["released"], ratio=table["ours"] / table["released"])


def _in_order(study: Study, table: pd.DataFrame) -> pd.DataFrame:
    """The table with units. Scenarios or categories keep their order; their rows are in the order of the study."""
    first = table.columns[0]
    ranks = {first: list(dict.fromkeys(table[first])), "label": list(study.rows)}
    ranks |= {"task": list(paper.TASKS), "metric": list(IN_STUDIES)}
    place = {column: table[column].map({name: rank for rank, name in enumerate(names)}) for column, names in ranks.items()}
    order = pd.DataFrame(place).sort_values(list(place)).index
    units = table["metric"].map({name: metric.paper_unit for name, metric in IN_STUDIES.items()})
    return table.assign(unit=units).loc[order].reset_index(drop=True)


def _labels(study: Study) -> dict[str, str]:
    """Method to label."""
    return {method: label for label, method in study.rows.items()}


def _pictures(own: Collected) -> str:
    """How pictures were scored, as far as it changes their scores against the paper's."""
    facts = [json.loads(text) for text in own.runs["images"].dropna()]
    scored = [fact for fact in facts if fact and "failed" not in fact]
    if not scored:
        return ""
    quirks = sorted({name for fact in scored for name in fact["quirks"]})
    lpips = sorted({str(fact["lpips"]) for fact in scored} - {"computed"})
    text = f"Quirks of the released evaluation of pictures that were on: {', '.join(quirks) or 'none'}."
    return " ".join([text, *(f"LPIPS not computed in some runs: {reason}." for reason in lpips)])


def _curve(numbers: StudyNumbers, path: Path) -> str:
    """The section with the picture of the number of regions, in a study of that number."""
    path.unlink(missing_ok=True)
    enough = len(cluster_methods(numbers.study.rows.values())) > 1 and len(numbers.counted)
    figure = clusters_figure(numbers.counted) if enough else None
    if figure is None:
        return ""
    save(figure, path)
    return f"![Chamfer distance against the number of regions K]({path.name})\n"


def left_out_items(numbers: StudyNumbers) -> list[Block]:
    """The runs that averages leave out, failures one by one and others by their reason, and the rows without a method."""
    own, study, runs = numbers.own, numbers.study, numbers.runs
    asked = set(runs["label"]) | {label for label, method in study.rows.items() if method in own.left_out}
    lines = [
        f"{label}: {method} is not among the methods of this benchmark"
        for label, method in study.rows.items()
        if label not in asked
    ]
    left = runs[~runs["counted"].astype(bool)]
    for (label, status, why), part in left.groupby(["label", "status", "why"], sort=False):
        names = [f"{row.scenario} / seed {row.seed}" for row in part.itertuples()]
        shown = names if status == "failed" else names[:NAMED]
        more = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
        lines.append(f"{label}, {', '.join(shown)}{more}: {' '.join(str(why).split())}")
    lines += left_out_lines(own.left_out, numbers.labels)
    return [Items(title=f"Not in the averages (every run: {numbers.name}_runs.csv)", items=lines)] if lines else []


def _write_released(numbers: StudyNumbers, folder: Path) -> str:
    """The comparison with the released PhysTwin, if its method is a row; returns the section that names it."""
    name, study, own = numbers.name, numbers.study, numbers.own
    method = next((method for method in RELEASED_METHODS if method in study.rows.values()), None)
    if method is None or not own.runs["scenario"].isin(paper.scenarios()).any():
        return ""
    table, stem = released_comparison(own, method), f"{name}_released_phystwin"
    write_text(folder / f"{stem}.csv", table.to_csv(index=False))
    head = f"# Ours ({method}) beside the released PhysTwin, per scenario\n"
    note = "mm; mean over seeds (± standard deviation). The released values of the training frames are known for 11 scenarios.\n"
    tables = []
    for (task, metric), part in table.groupby(["task", "metric"], sort=True):
        both = part.dropna(subset="ours")
        of_paper = IN_STUDIES[str(metric)]
        rows = [[Cell(text=str(row.scenario)), *_released_cells(row, of_paper)] for row in part.itertuples()]
        if len(both):
            mean = both[["released", "ours", "difference"]].mean()
            mean["ratio"], mean["spread"] = mean["ours"] / mean["released"], np.nan
            rows.append([Cell(text=f"mean of {len(both)}"), *_released_cells(mean, of_paper)])
        header = ["Scenario", "Released", "Ours", "Difference", "Ratio"]
        tables.append(Table(caption=f"{str(task).capitalize()}, {of_paper.paper_heading}", header=header, rows=rows))
    write_text(folder / f"{stem}.md", "\n".join([head, note, markdown(tables)]))
    count = int(table.loc[table["ours"].notna(), "scenario"].nunique())
    where = f"{count} of {len(paper.scenarios())} scenarios have finished" if count else "nothing has finished on its scenarios"
    return f"## Beside the released PhysTwin\n\n[Per scenario]({stem}.md): {where}.\n"


def _released_cells(row: Any, metric: Metric) -> list[Cell]:
    around = f" ± {metric.paper_text(row.spread)}" if np.isfinite(row.spread) else ""
    ratio = f"{row.ratio:.3f}" if np.isfinite(row.ratio) else DASH
    texts = [metric.paper_text(row.released), metric.paper_text(row.ours) + around, metric.paper_text(row.difference, "+"), ratio]
    return [Cell(text=text) for text in texts]
