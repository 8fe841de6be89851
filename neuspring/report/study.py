"""A study's numbers laid out beside the paper's: Markdown, LaTeX, CSV, and blocks of the report.

Per study, in one folder: <study>.md and .tex (to read), .csv (a row per cell), for the number of regions _curve.png. All other
numbers (which runs count, averages without and with failed runs, scenarios, categories) are in the benchmark's numbers.json.

Tables have the paper's layout: both tasks side by side, the best marked.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.table import LATEX_PREAMBLE, Cell, Table
from neuspring.draw.benchmark import cluster_methods, clusters_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Fold, Text, markdown
from neuspring.report.grid import Columns, Show, between, chip, grouped, rows
from neuspring.report.summary import failure_table, not_counted, settings_table
from neuspring.scores import paper
from neuspring.scores.failures import left_out_lines, removed_lines, unknown_lines
from neuspring.scores.metrics import DASH, Metric, present
from neuspring.scores.paper import Study
from neuspring.scores.runs import mixed_settings, pairs
from neuspring.scores.study import LEAST_SCENARIOS, ORACLE_LINE, StudyNumbers, in_order, verdict_text

VERDICT_NOTE = (
    "Verdict: within, the paper's value lies in the 95 % bootstrap interval of our mean, half a unit of its last digit allowed; "
    "better, worse: outside; partial: fewer than its 22 scenarios count; other data: these are other scenarios, whose values "
    "cannot be compared with the paper's."
)
DIRECTION_NOTE = (
    "Verdict: same direction, confirmed: our interval leaves out 0 on the paper's side; opposite: on the other side; not resolved: "
    f"it holds 0; better, worse: it leaves out 0, and the paper has no number; too few scenarios: fewer than {LEAST_SCENARIOS}, "
    "which too often change in one direction by chance."
)
BOUND_NOTE = (
    "TE bound: track error of points that move with the nodes around them, 0 for every rigid motion; TE has a floor, frame 0's."
)
FAILED_MARK = "*"
"""Stands beside the number of runs of a method if some of them failed."""
Mark = Literal["", "best", "second"]
Line = tuple[str, Show]
"""Name of a line and what it shows of a cell."""
Lines = Sequence[Line] | Callable[[Any], Sequence[Line]]
"""The same for all, or those of a cell."""


def write_study(numbers: StudyNumbers, folder: Path) -> str:
    """Write all files of a study; returns the Markdown."""
    name, study, own = numbers.name, numbers.study, numbers.own
    write_text(folder / f"{name}.csv", numbers.cells.assign(study=name).to_csv(index=False))
    tables, footnote = study_tables(numbers), settings_table(numbers.settings)
    floats = [table.latex(f"{name}-{index + 1}", f"{study.title}: {table.caption}") for index, table in enumerate(tables)]
    floats += [table.latex(f"{name}-settings", f"{study.title}: settings that differ") for table in footnote]
    write_text(folder / f"{name}.tex", "\n".join([LATEX_PREAMBLE, *floats]))
    warning = mixed_settings(own.runs)
    before: list[Block] = [Text(text=warning, tone="warn")] if warning else []
    parts = [f"# {study.title}\n", markdown([*before, *tables, *footnote])]
    path = folder / f"{name}_curve.png"
    path.unlink(missing_ok=True)
    if len(cluster_methods(study.rows.values())) > 1 and (figure := clusters_figure(numbers.chamfer)):
        parts.append(f"![Chamfer distance against the number of regions K]({save(figure, path).name})\n")
    text = "\n".join([*parts, markdown([*left_out_items(numbers), *value_tables(numbers)])])
    write_text(folder / f"{name}.md", text)
    return text


def study_blocks(numbers: StudyNumbers) -> list[Block]:
    """The same tables for the report."""
    first, *others = study_tables(numbers)
    last = [*settings_table(numbers.settings), *left_out_items(numbers), *value_tables(numbers)]
    folds = [Fold(summary=table.caption, blocks=[table]) for table in others]
    return [first, *folds, *([Fold(summary="Settings, runs that do not count, parts", blocks=last)] if last else [])]


def study_tables(numbers: StudyNumbers) -> list[Table]:
    """The tables that have rows. The note of the first one explains averages and verdicts."""
    study, own, cells = numbers.study, numbers.own, numbers.cells
    kept = pairs(numbers.runs[numbers.runs["counted"].astype(bool)])
    which = f"Averages take the {kept} of {pairs(own.runs)} pairs of scenario and seed "
    which += "that every method with a finished run has finished."
    finished = (own.runs["status"] == "ok").any()
    nothing = "No pair of scenario and seed was finished by every method." if finished else "Nothing has finished."
    removed = " ".join(removed_lines(own.comparison.runs, own.left_out, numbers.labels))
    notes = [VERDICT_NOTE if study.reference else "", which if kept else nothing, removed, _pictures(own.runs)]
    notes += [paper.CLUSTER_CLAIM] if cluster_methods(study.rows.values()) else []
    notes += [BOUND_NOTE] if "track_error_bound" in set(cells["metric"]) else []
    tables = [
        main_table(study, cells, " ".join(note for note in notes if note)),
        *study_failures(numbers),
        interval_table(cells[cells["ours"].notna()]),
        change_table(study, cells),
        *both_trainings(numbers),
    ]
    return [table for table in tables if table.rows]


def value_tables(numbers: StudyNumbers) -> list[Table]:
    """Ours per category and per scenario; beside the released PhysTwin's where the study has its method."""
    table, note = numbers.released, "mm; mean over seeds. The released values of the training frames are known for 11 scenarios."
    lines = {"released": "released", "ours": "ours", "difference": "ours - released"}
    released = [table.assign(value=table[name], label=label) for name, label in lines.items() if len(table)]
    beside = pd.concat(released).sort_values("scenario", kind="stable") if released else table
    parts = [
        ("Per category", "Ours, in the average that the paper takes.", ["Category", "Method"], numbers.categories),
        ("Per scenario", "Ours, all finished runs, seeds averaged.", ["Scenario", "Method"], numbers.scenarios),
        ("Beside the released PhysTwin", note, ["Scenario", ""], beside),
    ]
    value: list[Line] = [("", lambda cell, metric: Cell(text=metric.shown(cell.value)))]
    return [layout(title, note, table, stub, [stub[0].lower(), "label"], value) for title, note, stub, table in parts if len(table)]


def layout(caption: str, note: str, cells: pd.DataFrame, stub: Sequence[str], keys: Sequence[str], lines: Lines) -> Table:
    """A table of cells: for each combination of `keys` its `lines`, with a dash where there is no cell.

    A line begins with the keys, and with its name where the stub has room for it; below the first line keys are not repeated.
    """

    def stubbed(cell: Any) -> list[tuple[list[Cell], Show]]:
        own = lines(cell) if callable(lines) else lines
        headings = [["" if k else str(getattr(cell, key)) for key in keys] + [name] for k, (name, _) in enumerate(own)]
        return [([Cell(text=text) for text in texts[: len(stub)]], show) for texts, (_, show) in zip(headings, own, strict=True)]

    shown = columns_in(cells)
    return grouped(caption, stub, shown, rows(cells, shown, keys, stubbed, Cell(text=DASH)) if shown else [], note)


def columns_in(cells: pd.DataFrame) -> list[tuple[str, Metric]]:
    """Tasks and metrics of cells, in the paper's order."""
    return in_order(present(cells)) if len(cells) else []


def main_table(study: Study, cells: pd.DataFrame, more: str = "") -> Table:
    """The paper's table with ours and the verdict below every row. `more` is added to the note."""
    shown = columns_in(cells)
    marks = {source: _marks(study, cells, shown, source) for source in ("paper", "ours")}

    def marked(source: str, text: Callable[[Any, Metric], str]) -> Callable[[Any, Metric], Cell]:
        return lambda cell, metric: Cell(text=text(cell, metric), mark=marks[source].get((cell.label, cell.task, cell.metric), ""))

    def lines(cell: Any) -> list[tuple[list[Cell], Show]]:
        alone = cell.oracle or not study.reference
        ours = [Cell(text=cell.label if alone else ""), Cell(text=_runs(cell)), Cell(text="ours")], marked("ours", _ours)
        printed = [Cell(text=cell.label), Cell(), Cell(text="paper")], marked("paper", lambda cell, _: cell.paper or DASH)
        verdict = (
            [Cell(), Cell(), Cell(text="verdict")],
            lambda cell, _: Cell(chips=[chip(cell.verdict, verdict_text(cell._asdict()))]),
        )
        return [ours] if alone else [printed, ours, verdict]

    table, oracles = (rows(cells[cells["oracle"] == oracle], shown, ["label"], lines) for oracle in (False, True))
    table += [[Cell(text=ORACLE_LINE), *[Cell()] * (2 + len(shown))], *oracles] if oracles else []
    names = {metric.name for _, metric in shown}
    note = f"CD (single-directional L1 Chamfer distance) and TE (track error) in mm{', PSNR in dB' * ('psnr' in names)}. "
    note += "Ours: mean over scenarios, seeds averaged within each, ± standard deviation over seeds"
    if any(metric.average == "frames" for _, metric in shown):
        note += "; as the paper does, CD and TE weigh scenarios equally, scores of pictures weigh them by their frames"
    failed = f" {FAILED_MARK} Some runs failed; the table of failures has both averages, without and with them."
    note += f".{failed * bool(cells['failed'].any())} {more}"
    return grouped("Ours beside the paper's" if study.reference else "Ours", ["Method", "Runs", ""], shown, table, note.rstrip())


def _direction_cell(cell: Any, _: Metric) -> Cell:
    lacking = cell.direction == cell.verdict
    return Cell(chips=[chip(cell.direction, verdict_text(cell._asdict()) if lacking else "")])


def both_trainings(numbers: StudyNumbers) -> list[Table]:
    """Two studies of the same labels under one heading: values, and changes against the baseline of the same training."""
    study, beside = numbers.study, numbers.beside
    if beside is None:
        return []
    both = pd.concat([numbers.cells_beside.assign(training=beside.training), numbers.cells.assign(training=study.training)])
    shared = set(numbers.cells_beside["label"]) & set(study.rows)
    order = both["label"].map({label: place for place, label in enumerate(study.rows)})
    both = both.assign(place=order).sort_values("place", kind="stable")
    both = both[both["label"].isin(shared) & ~both["oracle"]]
    # A metric that nobody finished has no column here.
    both = both[pd.MultiIndex.from_frame(both[["task", "metric"]]).isin(present(both[both["ours"].notna()]))]

    def table(caption: str, cells: pd.DataFrame, text: Callable[[Any, Metric], str], note: str) -> Table:
        line: list[Line] = [("", lambda cell, metric: Cell(text=text(cell, metric)))]
        made = layout(caption, note, cells, ["Method", "Training"], ["label", "training"], line)
        first = [row[0].text for row in made.rows]
        return replace(
            made, rows=[[Cell(), *row[1:]] if k and first[k - 1] == first[k] else row for k, row in enumerate(made.rows)]
        )

    note = "The same rows in two trainings. Each is averaged over the scenarios and seeds that all its rows finished."
    against = f"{note} Against {study.baseline} of the same training, with the paired 95 % bootstrap interval."
    changed = both[both["label"] != both["baseline"]]
    return [table("Both trainings", both, _ours, note), table("Both trainings: change", changed, our_change, against)]


def interval_table(cells: pd.DataFrame) -> Table:
    """The interval of our mean, and its distance from the paper's value, of finished rows."""
    lines: list[Line] = [("95 %", lambda cell, metric: Cell(text=between(cell.low, cell.high, metric.shown) or DASH))]
    if compared := bool(cells["difference"].notna().any()):
        lines.append(("ours - paper", lambda cell, metric: Cell(text=metric.shown(cell.difference, "+"))))
    note = f"95 % bootstrap interval of our mean, over scenarios and seeds{'; ours minus the value of the paper' * compared}."
    return layout("Intervals", note, cells, ["Method", ""], ["label"], lines)


def change_table(study: Study, cells: pd.DataFrame) -> Table:
    """The change against the baseline, in the paper and here."""
    others = cells[~cells["oracle"] & (cells["label"] != study.baseline)]
    printed = set(others.loc[others["paper_change"].notna(), "label"])
    of_paper: list[Line] = [("paper", lambda cell, metric: Cell(text=paper_change(cell, metric)))]
    ours: list[Line] = [("ours", lambda cell, metric: Cell(text=our_change(cell, metric))), ("verdict", _direction_cell)]
    in_db = " (PSNR: in dB)" if any(not metric.relative for _, metric in columns_in(cells)) else ""
    note = (
        f"Change against {study.baseline} on the same scenarios and seeds, in per cent of its mean{in_db}, with the paired 95 % "
        f"bootstrap interval. {DIRECTION_NOTE}"
    )
    caption = f"Change against {study.baseline}"
    return layout(caption, note, others, ["Method", ""], ["label"], lambda cell: of_paper * (cell.label in printed) + ours)


def study_failures(numbers: StudyNumbers) -> list[Table]:
    """Rows whose method failed somewhere: both averages; nothing where none did."""
    means = numbers.failures
    failed = means[means["succeeded"] < means["attempted"]] if len(means) else means
    if not len(failed):
        return []
    labels = {method: label for method, label in numbers.labels.items() if method in set(failed["method"])}
    table = failure_table("Failures", failed, labels, columns_in(failed.dropna(subset="metric")), scale=False)
    note = " ".join([f"Rows marked {FAILED_MARK} above.", table.note, *unknown_lines(means, numbers.labels)])
    return [replace(table, note=note)]


def our_change(cell: Any, metric: Metric) -> str:
    """The change against the baseline and its interval, in per cent where that means something."""
    if metric.relative and np.isfinite(cell.relative):
        return f"{_percent(cell.relative)} % {between(cell.relative_low, cell.relative_high, _percent)}".rstrip()
    interval = between(cell.change_low, cell.change_high, lambda value: metric.shown(value, "+"))
    return f"{metric.shown(cell.change, '+')} {interval}".rstrip()


def paper_change(cell: Any, metric: Metric) -> str:
    """The change against the baseline that the paper prints, rounded as it is."""
    if np.isnan(cell.paper_change):
        return DASH
    return f"{_percent(cell.paper_relative)} %" if metric.relative else metric.shown(cell.paper_change, "+")


def _ours(cell: Any, metric: Metric) -> str:
    return metric.shown(cell.ours) + (f" ± {metric.shown(cell.spread)}" if np.isfinite(cell.spread) else "")


def _percent(value: float) -> str:
    return f"{100 * value:+.1f}"


def _runs(cell: Any) -> str:
    total = cell.ok + cell.failed + cell.missing
    wrong = ", ".join(f"{count} {name}" for name, count in (("failed", cell.failed), ("missing", cell.missing)) if count)
    mark = f" {FAILED_MARK}" if cell.failed else ""
    return f"{cell.ok}/{total}" + (f" ({wrong})" if wrong else "") + mark if total else DASH


def _marks(study: Study, cells: pd.DataFrame, shown: Columns, source: str) -> dict[tuple[str, str, str], Mark]:
    """Best and, where the paper marks it, second best of every column, as far as the printed digits tell."""
    marks: dict[tuple[str, str, str], Mark] = {}
    names: tuple[Mark, ...] = ("best", "second") if study.reference in paper.UNDERLINED else ("best",)
    for task, metric in shown:
        part = cells[(cells["task"] == task) & (cells["metric"] == metric.name) & ~cells["oracle"]]
        values = pd.to_numeric(part[source]).round(metric.digits)
        ranked = sorted(values.dropna().unique(), reverse=metric.higher_is_better)
        of_rank = dict(zip(ranked, names, strict=False)) if values.notna().sum() > 1 else {}
        marks |= {(label, task, metric.name): of_rank.get(value, "") for label, value in zip(part["label"], values, strict=True)}
    return marks


def _pictures(runs: pd.DataFrame) -> str:
    """Conditions of the scores of pictures, as far as they change their scores against the paper's."""
    facts = [json.loads(text) for text in runs["images"].dropna()]
    scored = [fact for fact in facts if fact and "failed" not in fact]
    if not scored:
        return ""
    lpips = sorted({str(fact["lpips"]) for fact in scored} - {"computed"})
    return " ".join(f"LPIPS not computed in some runs: {reason}." for reason in lpips)


def left_out_items(numbers: StudyNumbers) -> list[Block]:
    """The runs that averages leave out, failures one by one and others by their reason, and the rows without a method."""
    own, study, runs = numbers.own, numbers.study, numbers.runs
    asked = set(runs["label"]) | {label for label, method in study.rows.items() if method in own.left_out}
    absent = {label: method for label, method in study.rows.items() if label not in asked}
    lines = [f"{label}: {method} is not among the methods of this benchmark" for label, method in absent.items()]
    return not_counted(runs, lines, left_out_lines(own.left_out, numbers.labels))
