"""Tables of a study as Markdown and LaTeX, in the layout of the paper: both tasks side by side, the best marked."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from neuspring.core.text import markdown
from neuspring.report.tables.cells import ORACLE_LINE, in_order
from neuspring.report.tables.differing import ABOUT, Differing
from neuspring.scores import paper
from neuspring.scores.failures import DASHES, WHY, mean_rows
from neuspring.scores.metrics import DASH, IN_STUDIES, SHORT, Metric, present
from neuspring.scores.studies import Study

Mark = Literal["", "best", "second"]
LONG = {"reconstruction": "Reconstruction & Resimulation", "future": "Future Prediction"}
FAILED_MARK = "*"
"""Stands beside the number of runs of a method if some of them failed."""
TEX = {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{character: f"\\{character}" for character in "{}%_&#$"},
    **{"±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "–": "--", "<": r"$<$", ">": r"$>$", "|": r"$|$", "[": "{[}"},
}
PREAMBLE = "% Needs \\usepackage{booktabs} and \\usepackage{graphicx}."


class Text(NamedTuple):
    """A cell and how it is marked."""

    text: str
    mark: Mark = ""


Line = tuple[tuple[str, ...], list[Text]]
"""Cells of the stub and of the columns. A line whose first cell is empty belongs to the line above."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table whose columns are tasks and metrics."""

    title: str
    note: str
    """One paragraph."""
    stub: tuple[str, ...]
    """Headings of the columns before the metrics."""
    columns: list[tuple[str, Metric]]
    lines: list[Line]

    @property
    def headings(self) -> list[str]:
        """Of the columns, with arrows that say which direction is better."""
        return [f"{SHORT[task]} {metric.paper_column}" for task, metric in self.columns]


def _interval(low: float, high: float, show: Callable[[float], str]) -> str:
    return f"[{show(low)}, {show(high)}]" if np.isfinite(low) else ""


def main_grid(study: Study, cells: pd.DataFrame) -> Grid:
    """The paper's table with ours and the verdict below every row."""
    columns = _columns(cells)
    marks = {source: _marks(study, cells, columns, source) for source in ("paper", "ours")}
    lines: list[Line] = []
    for label, part in _rows(cells[~cells["oracle"]]):
        printed, ours, verdicts = [], [], []
        for task, metric in columns:
            cell = part[task, metric.name]
            key = (label, task, metric.name)
            spread = f" ± {metric.paper_text(cell.spread)}" if np.isfinite(cell.spread) else ""
            printed.append(Text(cell.paper or DASH, marks["paper"].get(key, "")))
            ours.append(Text(metric.paper_text(cell.ours) + spread, marks["ours"].get(key, "")))
            verdicts.append(Text(cell.verdict))
        lines += [((label, "", "paper"), printed)] if study.reference else []
        lines.append((("" if study.reference else label, _runs(cell), "ours"), ours))
        lines += [(("", "", "verdict"), verdicts)] if study.reference else []
    lines += [((names[0], "", names[1]), texts) for names, texts in _oracle_lines(cells, columns)]
    note = (
        f"{_units(columns)} Ours: mean over scenarios, seeds averaged within each, ± standard deviation over seeds"
        f"{_conventions(columns)}."
    )
    if cells["failed"].any():
        note += f" {FAILED_MARK} Some runs failed; the table of failures has both averages, without and with them."
    return Grid(title="", note=note, stub=("Method", "Runs", ""), columns=columns, lines=lines)


def _oracle_lines(cells: pd.DataFrame, columns: list[tuple[str, Metric]]) -> list[Line]:
    """A line that says what oracles are, then theirs; never marked."""
    lines: list[Line] = []
    for label, part in _rows(cells[cells["oracle"]]):
        texts = [Text(metric.paper_text(part[task, metric.name].ours)) for task, metric in columns]
        lines += [] if lines else [((ORACLE_LINE, ""), [Text("")] * len(columns))]
        lines.append(((label, "ours"), texts))
    return lines


def beyond_grid(study: Study, cells: pd.DataFrame) -> Grid:
    """Metrics that the paper does not have: ours, its interval, the change against the baseline and its verdict."""
    columns, lines = _columns(cells), list[Line]()
    for label, part in _rows(cells[~cells["oracle"]]):
        here = [(part[task, metric.name], metric) for task, metric in columns]
        spreads = [f" ± {metric.paper_text(cell.spread)}" if np.isfinite(cell.spread) else "" for cell, metric in here]
        ours = [metric.paper_text(cell.ours) + spread for (cell, metric), spread in zip(here, spreads, strict=True)]
        lines.append(((label, "ours"), [Text(text) for text in ours]))
        intervals = [_interval(cell.low, cell.high, metric.paper_text) or DASH for cell, metric in here]
        lines.append((("", "95 %"), [Text(text) for text in intervals]))
        if label != study.baseline:
            lines.append((("", "change"), [Text(our_change(cell, metric)) for cell, metric in here]))
            lines.append((("", "verdict"), [Text(cell.direction) for cell, _ in here]))
    lines += _oracle_lines(cells, columns)
    note = (
        "TE bound: track error, in m, of points that move with the nodes around them. It is 0 for every rigid motion. TE has "
        f"a floor, its value in frame 0. Change against {study.baseline} with the paired 95 % bootstrap interval."
    )
    return Grid(title="Without a floor", note=note, stub=("Method", ""), columns=columns, lines=lines)


def both_trainings(study: Study, cells: pd.DataFrame, beside: Study, others: pd.DataFrame) -> list[Grid]:
    """Two studies of the same labels under one heading: values, and changes against the baseline of the same training."""
    blocks = [(beside, others), (study, cells)]
    finished = [table[table["ours"].notna()] for _, table in blocks if len(table)]
    columns = in_order({(task, metric.name) for table in finished for task, metric in _columns(table)})
    by_label = [dict(_rows(table[~table["oracle"]])) for _, table in blocks]
    values, changes = list[Line](), list[Line]()
    for label in (label for label in study.rows if label in by_label[0] and label in by_label[1]):
        for number, (block, rows) in enumerate(zip(blocks, by_label, strict=True)):
            here = [(rows[label].get((task, metric.name)), metric) for task, metric in columns]
            stub = ("" if number else label, block[0].training)
            values.append((stub, [Text(_value(cell, metric)) for cell, metric in here]))
            if label != block[0].baseline:
                changes.append((stub, [Text(our_change(cell, metric) if cell else DASH) for cell, metric in here]))
    note = "The same rows in two trainings. Each is averaged over the scenarios and seeds that all its rows finished."
    against = f"{note} Against {study.baseline} of the same training, with the paired 95 % bootstrap interval."
    grids = [("Both trainings", note, values), ("Both trainings: change", against, changes)]
    stub = ("Method", "Training")
    return [
        Grid(title=title, note=text, stub=stub, columns=columns, lines=lines) for title, text, lines in grids if lines and columns
    ]


def _value(cell: Any, metric: Metric) -> str:
    if cell is None:
        return DASH
    return metric.paper_text(cell.ours) + (f" ± {metric.paper_text(cell.spread)}" if np.isfinite(cell.spread) else "")


def interval_grid(cells: pd.DataFrame) -> Grid:
    """The interval of our mean, and its distance from the paper's value, of finished rows."""
    finished = cells[cells["ours"].notna()]
    columns, lines = _columns(finished), list[Line]()
    compared = bool(finished["difference"].notna().any())
    for label, part in _rows(finished):
        here = [(part.get((task, metric.name)), metric) for task, metric in columns]
        intervals = [_interval(cell.low, cell.high, metric.paper_text) if cell else "" for cell, metric in here]
        lines.append(((label, "95 %"), [Text(text or DASH) for text in intervals]))
        if compared:
            distances = [metric.paper_text(cell.difference, "+") if cell else DASH for cell, metric in here]
            lines.append((("", "ours - paper"), [Text(text) for text in distances]))
    note = f"95 % bootstrap interval of our mean, over scenarios and seeds{'; ours minus the value of the paper' * compared}."
    return Grid(title="Intervals", note=note, stub=("Method", ""), columns=columns, lines=lines)


def change_grid(study: Study, cells: pd.DataFrame) -> Grid:
    """The change against the baseline, in the paper and here."""
    columns, lines = _columns(cells), list[Line]()
    for label, part in _rows(cells[~cells["oracle"]]):
        if label == study.baseline:
            continue
        here = [(part[task, metric.name], metric) for task, metric in columns]
        if any(np.isfinite(cell.paper_change) for cell, _ in here):
            lines.append(((label, "paper"), [Text(paper_change(cell, metric)) for cell, metric in here]))
        first = label if not lines or lines[-1][0][0] != label else ""
        lines.append(((first, "ours"), [Text(our_change(cell, metric)) for cell, metric in here]))
        lines.append((("", "verdict"), [Text(cell.direction) for cell, _ in here]))
    in_db = " (PSNR: in dB)" if any(not metric.relative for _, metric in columns) else ""
    note = (
        f"Change against {study.baseline} on the same scenarios and seeds, in per cent of its mean{in_db}, with the paired 95 % "
        "bootstrap interval."
    )
    return Grid(title=f"Change against {study.baseline}", note=note, stub=("Method", ""), columns=columns, lines=lines)


def other_grid(cells: pd.DataFrame) -> Grid:
    """Ours in the average that the paper does not use."""
    table = cells[cells["ours"].notna()].assign(value=cells["other_average"])
    note = "Ours in the other average: CD and TE weighted by frames, pictures with equal weights of scenarios."
    return values_grid("The other average", note, ("Method",), table, ["label"])


def failures_grid(study: Study, means: pd.DataFrame) -> Grid:
    """Rows whose method failed somewhere: both averages (`failures.both_averages`), weighted as the paper does."""
    table = means[means["succeeded"] < means["attempted"]].dropna(subset="metric")
    columns, lines = in_order(present(table)), list[Line]()
    for label, method in study.rows.items():
        part = means[means["method"] == method]
        if not len(part) or part.iloc[0]["succeeded"] == part.iloc[0]["attempted"]:
            continue
        rows = {(row.task, row.metric): row for row in part.itertuples()}
        stub = (label, f"{part.iloc[0]['succeeded']}/{part.iloc[0]['attempted']}")
        for over, name in mean_rows(part):
            texts = [Text(_mean(rows.get((task, metric.name)), name, metric)) for task, metric in columns]
            lines.append(((*stub, over), texts))
            stub = ("", "")
    note = f"Rows marked {FAILED_MARK} above. {WHY} {DASHES}"
    return Grid(title="Failures", note=note, stub=("Method", "Succeeded", "Mean over"), columns=columns, lines=lines)


def _mean(row: Any, name: str, metric: Metric) -> str:
    if row is None:
        return DASH
    return metric.paper_text(float(getattr(row, name if metric.average == "equal" else f"{name}_frames")))


def values_grid(title: str, note: str, stub: tuple[str, ...], table: pd.DataFrame, keys: list[str]) -> Grid:
    """Any table of ours in long form (task, metric, value and `keys`), one line per combination of keys."""
    columns, lines = in_order(present(table)), list[Line]()
    for names, part in table.groupby(keys, sort=False):
        values = part.set_index(["task", "metric"])["value"].to_dict()
        texts = [Text(metric.paper_text(values.get((task, metric.name), np.nan))) for task, metric in columns]
        lines.append((tuple(map(str, names)), texts))
    return Grid(title=title, note=note, stub=stub, columns=columns, lines=lines)


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


def _percent(value: float) -> str:
    return f"{100 * value:+.1f}"


def _columns(cells: pd.DataFrame) -> list[tuple[str, Metric]]:
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


def _units(columns: list[tuple[str, Metric]]) -> str:
    text = "CD (single-directional L1 Chamfer distance) and TE (track error) in m"
    return f"{text}, PSNR in dB." if any(metric.name == "psnr" for _, metric in columns) else f"{text}."


def _conventions(columns: list[tuple[str, Metric]]) -> str:
    if not any(metric.average == "frames" for _, metric in columns):
        return ""
    return "; as the paper does, CD and TE weigh scenarios equally, scores of pictures weigh them by their frames"


def _marks(study: Study, cells: pd.DataFrame, columns: list[tuple[str, Metric]], source: str) -> dict[tuple[str, str, str], Mark]:
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


def as_markdown(grid: Grid, level: str = "##") -> str:
    """Heading, note and table in Markdown."""
    header = [*grid.stub, *grid.headings]
    rows = [[*map(_plain, stub), *map(_marked, texts)] for stub, texts in grid.lines]
    parts = [f"{level} {grid.title}"] * bool(grid.title) + [grid.note] * bool(grid.note)
    return "\n\n".join([*parts, "\n".join(markdown(header, rows))]) + "\n"


def _plain(text: str) -> str:
    return text.replace("|", "\\|")


def _marked(cell: Text) -> str:
    around = {"": "{}", "best": "**{}**", "second": "<ins>{}</ins>"}[cell.mark]
    return around.format(_plain(cell.text))


def as_latex(grid: Grid, label: str, title: str) -> str:
    """A float to \\input, in the paper's layout; `PREAMBLE` says what it needs."""
    stub, tasks = len(grid.stub), [task for task, _ in grid.columns]
    spans, rules, first = [], [], stub + 1
    for task in dict.fromkeys(tasks):
        count = tasks.count(task)
        spans.append(f"\\multicolumn{{{count}}}{{c}}{{{tex(LONG[task])}}}")
        rules.append(f"\\cmidrule(lr){{{first}-{first + count - 1}}}")
        first += count
    lines = [
        "\\begin{table*}[t]\n\\centering\n\\small\n\\resizebox{\\linewidth}{!}{%",
        f"\\begin{{tabular}}{{@{{}} {'l' * stub} {'r' * len(tasks)} @{{}}}}",
        "\\toprule",
        _tex_row(["Task", *[""] * (stub - 1), *spans]),
        " ".join(rules),
        _tex_row([*map(tex, grid.stub), *(tex(metric.paper_column) for _, metric in grid.columns)]),
        "\\midrule",
    ]
    grouped = any(not names[0] for names, _ in grid.lines)
    for index, (names, texts) in enumerate(grid.lines):
        lines += ["\\addlinespace"] if index and grouped and names[0] else []
        lines.append(_tex_row([*map(tex, names), *map(_tex_marked, texts)]))
    caption = f"\\caption{{\\textbf{{{tex(title)}.}} {tex(grid.note)}}}"
    lines += ["\\bottomrule", "\\end{tabular}}", caption, f"\\label{{tab:{label}}}", "\\end{table*}"]
    return "\n".join(lines) + "\n"


def differing_latex(rows: list[Differing], label: str, title: str) -> list[str]:
    """The footnote on settings that differ, as a float of its own; nothing if none does."""
    if not rows:
        return []
    lines = ["\\begin{table*}[t]\n\\centering\n\\footnotesize", "\\begin{tabular}{@{} l p{0.75\\linewidth} @{}}", "\\toprule"]
    lines += [_tex_row([tex("Setting"), tex("Value: rows")]), "\\midrule"]
    lines += [_tex_row([tex(row.setting), tex(row.text)]) for row in rows]
    caption = f"\\caption{{\\textbf{{{tex(title)}: settings that differ.}} {tex(ABOUT)}}}"
    return [
        "\n".join([*lines, "\\bottomrule", "\\end{tabular}", caption, f"\\label{{tab:{label}-settings}}", "\\end{table*}"]) + "\n"
    ]


def _tex_row(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"


def _tex_marked(cell: Text) -> str:
    around = {"": "{}", "best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}[cell.mark]
    return around.format(tex(cell.text))


def tex(text: str) -> str:
    """Plain text for LaTeX: special characters escaped, minus signs in mathematics."""
    escaped = "".join(TEX.get(character, character) for character in text)
    return re.sub(r"(?<![\w$.-])-(?=\d)", "$-$", escaped)
