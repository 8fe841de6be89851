"""Tables of the long table: the verdict, averages, ratios, failures, costs. summary.md and report.html contain the same tables."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuspring.config import Method
from neuspring.config.parse import read_rows
from neuspring.config.settings import Aim
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.table import Cell, Table, Tone
from neuspring.draw.benchmark import ratios_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Fold, Text, markdown
from neuspring.scores import queries, statistics
from neuspring.scores.metrics import DASH, METRICS, SHORT, Metric, present
from neuspring.scores.table import ScoreTable, comparable, differing, mixed_settings, of_kind, pairs

TONES: dict[str, Tone] = {
    **dict.fromkeys((statistics.BELOW, statistics.REACHED, "better", "within"), "good"),
    **dict.fromkeys((statistics.ABOVE, statistics.MISSED, "worse", "failed"), "bad"),
}
"""Verdict -> its color. All other verdicts are gray."""
ARROWS = {"higher": "↑", "lower": "↓", "neither": ""}
CONDITIONS = ("views", "masks", "backend", "lpips", "failed")
"""Conditions of the image scores that tables state."""
AVERAGED = {"positions": "Errors, mm", "pictures": "Image scores", "marks": "Errors of annotated points"}
MOST_NAMED = 6
COLUMN_LEGEND = (
    "Recon. (reconstruction): mean over the training frames, on which methods are fitted; Future: mean over all later frames. "
    "↓: lower is better; ↑: higher is better. CD (Chamfer distance): mean distance from observed surface points to the nearest "
    "predicted point. TE (track error): mean distance between predicted and observed tracks. IoU: overlap of predicted and "
    "observed silhouettes."
)
"""Explanation of column headings, in the words of config/GLOSSARY.md."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A long table, with the baseline, objects and aims that its tables compare."""

    table: ScoreTable
    baseline: str
    objects: statistics.Objects = "scenario"
    aims: tuple[Aim, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    """Method -> displayed name, for methods with a title."""

    def name(self, method: str) -> str:
        """The displayed name of a method: title and identifier, else the identifier."""
        return self.names.get(method, method)

    def named(self, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows with displayed names in the column `method`."""
        return rows.assign(method=rows["method"].map(self.name))


def shown_names(method_table: Path, extra: Iterable[Path] = ()) -> dict[str, str]:
    """Method -> "title (`method`)", for methods with a title. Empty if the file does not exist."""
    rows = read_rows(Method, method_table, "method", extra) if method_table.is_file() else {}
    return {name: f"{row.title} (`{name}`)" for name, row in rows.items() if row.title}


def several(count: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def judged(*texts: object, verdict: str) -> list[Cell]:
    """The cells of a row; the last cell is the verdict in its color."""
    return [*(Cell(text=str(text)) for text in texts), Cell(text=verdict, tone=TONES.get(verdict, "mute"))]


def pivot(caption: str, cells: pd.DataFrame, index: Mapping[str, str], note: str = "") -> Table:
    """A table with one column per task and metric.

    - `cells`: columns task, metric, text and those of `index`; optional: value (sorting key), mark, tone
    - `index`: column that identifies a row -> heading
    """
    available = present(cells)
    columns = [(task, metric) for task in SHORT for metric in METRICS.values() if (task, metric.name) in available]
    rows = []
    for key, part in cells.groupby(list(index), sort=False):
        by_column = {(row["task"], row["metric"]): row for row in part.to_dict("records")}
        rows.append(
            [*(Cell(text=str(text)) for text in key), *(_cell(by_column.get((task, metric.name), {})) for task, metric in columns)]
        )
    heads = [f"{SHORT[task]} {metric.column} {ARROWS[metric.better]}".rstrip() for task, metric in columns]
    return Table(caption=caption, header=[*index.values(), *heads], rows=rows, note=note, stub=len(index))


def _cell(row: Mapping[Any, Any]) -> Cell:
    if not row:
        return Cell(text=DASH, value="", tone="mute")
    return Cell(text=row["text"], value=row.get("value"), mark=row.get("mark", ""), tone=row.get("tone", ""))


def texts(cells: pd.DataFrame, text: Callable[[Any, Metric], str]) -> pd.DataFrame:
    """Add the column `text`, a function of row and metric."""
    return cells.assign(text=[text(row, METRICS[str(row.metric)]) for row in cells.itertuples()])


def best(cells: pd.DataFrame, value: str, by: tuple[str, ...] = ()) -> pd.DataFrame:
    """Add the column `mark`: "best" for the best value of each task and metric, if there are at least two values to rank."""
    signs = cells["metric"].map(lambda name: {"higher": -1.0, "lower": 1.0}.get(METRICS[name].better, np.nan))
    key = [cells[name] for name in ("task", "metric", *by)]
    signed = (signs * cells[value]).groupby(key)
    top = (signs * cells[value] == signed.transform("min")) & (signed.transform("count") > 1)
    return cells.assign(mark=top.map({True: "best", False: ""}))


def ratio_text(row: Any) -> str:
    """A ratio and its interval in the form that all tables use."""
    if pd.isna(row.ratio):
        return DASH
    return f"{row.ratio:.3f}" + ("" if pd.isna(row.ratio_low) else f" [{row.ratio_low:.3f}, {row.ratio_high:.3f}]")


def change_text(row: Any, metric: Metric, scale: bool = True) -> str:
    """A row of `statistics.changes` as text: a ratio of errors or a difference of image scores, with its interval."""
    text = metric.text if scale else metric.shown
    show = "{:.3f}".format if metric.is_error else lambda value: text(value, "+")
    interval = f" [{show(row.change_low)}, {show(row.change_high)}]" if pd.notna(row.change_low) else ""
    return DASH if pd.isna(row.change) else f"{show(row.change)}{interval}"


def verdict(numbers: Compared) -> list[Block]:
    """One sentence that names the better method, and a table that compares every method with its rival."""
    runs, table = numbers.table.runs, queries.duels(numbers.table, numbers.baseline, numbers.objects)
    if not len(table):
        return [Text(text=f"No comparison is possible yet: {sum(runs['status'] == 'ok')} of {len(runs)} runs have finished.")]
    first = table.iloc[0]
    metric = METRICS[first["metric"]]
    pair = table.iloc[1] if first["rival"] == "" and len(table) > 1 else first
    method, rival = numbers.name(pair["method"]), numbers.name(pair["rival"])
    counts = ", ".join(several(runs[name].nunique(), name) for name in ("scenario", "seed"))
    what = f"{metric.title} on {'future' if first['task'] == 'future' else 'training'} frames"
    leaders = {statistics.BELOW: f"{method} is ahead", statistics.ABOVE: f"{rival} is ahead"}
    leader = leaders.get(pair["verdict"], f"No method is ahead ({pair['verdict']})")
    sentence = f"{leader}: the {what} of {method} is {ratio_text(pair)} times that of {rival} ({counts})."
    rows = [
        judged(
            numbers.name(str(row.method)),
            metric.text(row.error),
            numbers.name(str(row.rival)),
            metric.text(row.rival_error),
            ratio_text(row),
            f"{row.better:.0f} of {row.of:.0f}" if row.rival else "",
            f"{row.worst} ({metric.text(row.worst_error)})",
            verdict=row.verdict,
        )
        for row in _rows(table)
    ]
    header = ["Method", "Error", "Rival", "Rival's error", "Ratio [95 %]", "Better in", "Worst scenario (error)", "Verdict"]
    note = (
        f"Errors in {metric.shown_unit}: mean over the scenarios that all methods finished. Ratio: error of the method over that "
        f"of its rival, geometric mean over objects ({numbers.objects}) with a 95 % interval. Better in: scenarios in which the "
        f"method has the smaller error. Verdict: the interval is below 1 (the method is better), above 1 (the rival is better) or "
        f"contains 1 (not resolved); an interval requires {statistics.LEAST_OBJECTS} objects."
    )
    lead = sentence if pair["rival"] else f"Only {method} has results: {what} ({counts})."
    return [Text(text=lead, tone="lead"), Table(caption=what.capitalize(), header=header, rows=rows, note=note)]


def summary_blocks(numbers: Compared) -> list[Block]:
    """Averages, breakdowns, aims, comparison with the baseline."""
    table, compared = numbers.table, numbers.table.comparison
    usable, finished = comparable(compared.finished), compared.finished
    blocks: list[Block] = [Text(text=COLUMN_LEGEND)]
    if mixed := mixed_settings(table.runs):
        text = f"Runs of the same method have different settings ({', '.join(mixed)}). Repeat the older runs."
        blocks.append(Text(text=text, tone="warn"))
    if pairs(usable) < pairs(compared.runs):
        text = f"Averages use the {pairs(usable)} of {pairs(compared.runs)} pairs of scenario and seed that every method finished."
        blocks.append(Text(text=text))
    blocks += [average_table(numbers, kind) for kind in AVERAGED if len(of_kind(usable, kind))]
    blocks += _breakdowns(numbers, finished)
    blocks += _aims(numbers)
    if len(changes := statistics.changes(finished, numbers.baseline, numbers.objects)):
        shown = texts(numbers.named(changes), change_text)
        shown = shown.assign(
            text=shown["text"] + shown["verdict"].map(lambda name: f": {name}" if name else ""),
            tone=shown["verdict"].map(lambda name: TONES.get(name, "")),
            value=shown["change"],
        )
        note = (
            "CD and TE: error of the method over that of the baseline, below 1 if the method is better; geometric mean over "
            f"objects ({numbers.objects}) with a 95 % t interval, which requires {statistics.LEAST_OBJECTS} objects. Other scores: "
            "difference with a 95 % bootstrap interval over scenarios and seeds. All runs that both methods finished are used."
        )
        blocks.append(pivot(f"Compared with {numbers.name(numbers.baseline)}", shown, {"method": "Method"}, note))
    return blocks


def average_table(numbers: Compared, kind: str) -> Table:
    """Mean scores of every method for one kind of metric (`Metric.of`); oracles are labeled."""
    table, usable = numbers.table, of_kind(comparable(numbers.table.comparison.finished), kind)
    means, oracles = of_kind(queries.means(table), kind), table.oracles
    spread_known = usable["seed"].nunique() > 1
    weighted = bool((usable.groupby(["task", "metric"])["frames"].nunique() > 1).any())

    def text(row: Any, metric: Metric) -> str:
        spread = f" ± {metric.text(row.seed_std)}" if spread_known else ""
        return f"{metric.text(row.equal)}{spread}" + (f" ({metric.text(row.frames)})" if weighted else "")

    shown = texts(best(means.assign(ranked=means["equal"].where(~means["method"].isin(oracles))), "ranked"), text)
    runs = {method: _runs(part["status"]) for method, part in table.runs.groupby("method", sort=False)}
    shown = shown.sort_values("method", key=lambda column: column.map(table.methods.index), kind="stable")
    names = {method: f"{numbers.name(method)}{' (oracle)' * (method in oracles)}" for method in table.methods}
    shown = shown.assign(method=shown["method"].map(names), runs=shown["method"].map(runs), value=shown["equal"])
    explained = "; ".join(
        f"{m.heading}: {m.explained or m.title}"
        for m in METRICS.values()
        if m.title != m.heading and m.name in set(shown["metric"])
    )
    counts = ", ".join(several(table.runs[name].nunique(), name) for name in ("scenario", "seed"))
    note = (
        f"Mean over {counts}{', ± standard deviation over seeds' * spread_known}"
        f"{'; in brackets the mean weighted by frames' * weighted}.{explained and f' {explained}.'}"
    )
    note += _conditions(table) if kind == "pictures" else ""
    return pivot(AVERAGED[kind], shown, {"method": "Method", "runs": "Runs"}, note)


def _runs(status: pd.Series) -> str:
    failed = int((status == "failed").sum())
    return f"{int((status == 'ok').sum())}/{len(status)}" + (f" ({failed} failed)" if failed else "")


def _conditions(table: ScoreTable) -> str:
    """How the images were scored, from the records of the runs."""
    facts = [fact for text in dict.fromkeys(table.runs["images"]) if (fact := json.loads(text))]
    by_key = {
        key: {", ".join(np.atleast_1d(fact[key]).astype(str)) for fact in facts if fact.get(key, "") not in ("", "computed")}
        for key in CONDITIONS
    }
    parts = [f"{key}: {' or '.join(sorted(values))}" for key, values in by_key.items() if values]
    return f" Conditions: {'; '.join(parts)}." if parts else ""


def _breakdowns(numbers: Compared, finished: pd.DataFrame) -> Iterator[Fold]:
    """Means of all finished runs per category and per scenario, seeds averaged."""
    rows = of_kind(finished, "positions")
    counts = {column: rows[column].nunique() for column in ("category", "scenario")}
    for column, count in counts.items():
        if count > 1 and (column == "scenario" or count < counts["scenario"]):
            yield Fold(summary=f"Per {column}", blocks=[breakdown(numbers.named(rows), column)], open=count <= 4)


def breakdown(rows: pd.DataFrame, column: str, method: str = "method", scale: bool = True) -> Table:
    """Means of finished runs per scenario or category; with `scale`, values are in stored units."""
    by_scenario = rows.groupby([column, method, "task", "metric", "scenario"], sort=False)["value"].mean()
    means = by_scenario.groupby(level=[column, method, "task", "metric"], sort=False).mean().reset_index()
    shown = texts(best(means, "value", (column,)), lambda row, metric: (metric.text if scale else metric.shown)(row.value))
    return pivot(f"Per {column}", shown, {column: column.capitalize(), method: "Method"}, "All finished runs, averaged over seeds.")


def _aims(numbers: Compared) -> Iterator[Table]:
    rows = [
        judged(
            numbers.name(row.method),
            numbers.name(row.baseline),
            f"{SHORT[row.task]} {METRICS[row.metric].heading}",
            f"at most {row.aim:.2f}, interval below {row.below:g}",
            ratio_text(row),
            row.n,
            verdict=row.aim_verdict,
        )
        for row in _rows(statistics.judged_aims(numbers.table.comparison.finished, numbers.aims, numbers.objects))
    ]
    if rows:
        header = ["Method", "Rival", "Error", "Aim for the ratio", "Ratio [95 %]", "Objects", "Verdict"]
        yield Table(caption="Aims of the configuration", header=header, rows=rows)


def _rows(table: pd.DataFrame) -> list[Any]:
    return list(table.itertuples())


def failure_blocks(numbers: Compared, scale: bool = True) -> list[Block]:
    """Means without and with failed runs; runs outside the averages and scenarios without a method, with the reasons."""
    table, blocks = numbers.table, list[Block]()
    if len(averages := queries.with_failures(table.comparison)):
        lines = [
            averages.assign(over=over, shown=averages[column])
            for column, over in (("own", "successful runs"), ("all", "successful and failed runs"))
        ]
        shown = texts(pd.concat(lines), lambda row, metric: (metric.text if scale else metric.shown)(row.shown))
        note = "The prediction of a failed run stays at its last finite frame."
        index = {"method": "Method", "over": "Mean over"}
        blocks.append(pivot("Means with failed runs", numbers.named(shown.sort_values("method", kind="stable")), index, note))
    rows = []
    failed = table.runs[table.runs["status"] != "ok"]
    for (method, status, reason), part in failed.groupby(["method", "status", "reason"], sort=False):
        names = [f"{row.scenario}/{row.seed}" for row in _rows(part)]
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        rows.append((method, status, ", ".join(names[:MOST_NAMED]) + more, reason))
    rows += [(method, "does not apply", name, why) for method, where in table.left_out.items() for name, why in where.items()]
    if rows:
        made = [
            [*judged(numbers.name(str(method)), verdict=str(status)), *(Cell(text=str(text), wrap=True) for text in rest)]
            for method, status, *rest in rows
        ]
        blocks.append(Table(caption="Runs outside the averages", header=["Method", "Status", "Scenario/seed", "Reason"], rows=made))
    return blocks


def settings_table(runs: pd.DataFrame, names: Callable[[str], str]) -> list[Table]:
    """The recorded settings that differ between methods."""
    rows = []
    for setting, values in differing(runs).items():
        by_value: dict[str, list[str]] = {}
        for method in (name for name in dict.fromkeys(runs["method"]) if name in values):
            by_value.setdefault(values[method], []).append(names(method))
        text = "; ".join(f"{value}: {', '.join(methods)}" for value, methods in by_value.items())
        rows.append([Cell(text=setting), Cell(text=text, wrap=True)])
    note = "Values that the runs recorded. A method is listed only for settings of its own stages."
    heads = ["Setting", "Value: methods"]
    return [Table(caption="Settings that differ between methods", header=heads, rows=rows, note=note)] if rows else []


def cost_table(numbers: Compared) -> Table:
    """Median wall time, peak memory and epochs of each stage per method, and whether half of its fits have converged."""
    units = {"time": "{:.1f} s", "memory": "{:.0f} MB", "epochs": "{:.0f} epochs", "converged": "{:.0%} converged"}
    rows = numbers.table.task(*units).groupby(["method", "metric", "task"], sort=False)["value"].median()
    stages = list(dict.fromkeys(rows.index.get_level_values("metric")))
    known, made = rows.to_dict(), []
    for method in dict.fromkeys(rows.index.get_level_values("method")):
        keys = [[((method, stage, task), unit) for task, unit in units.items()] for stage in stages]
        parts = [", ".join(unit.format(known[key]) for key, unit in stage if key in known) for stage in keys]
        made.append([numbers.name(method), *(part or DASH for part in parts)])
    return Table.of_texts(["Method", *stages], made, "Medians of time, memory and epochs per stage")


def ratios_drawn(numbers: Compared) -> tuple[str, Figure] | None:
    """Caption and figure of the ratios with their intervals; None if there are no ratios."""
    ratios = statistics.ratios(numbers.table.comparison.finished, numbers.baseline, numbers.objects)
    # Figures would print backticks as they are.
    figure = ratios_figure(numbers.named(ratios).replace("`", "", regex=True), numbers.name(numbers.baseline).replace("`", ""))
    return (f"Errors of every method, divided by those of {numbers.name(numbers.baseline)}", figure) if figure else None


def write(numbers: Compared, folder: Path) -> str:
    """Write scores.csv, runs.csv, summary.md and its figure; returns the tables of summary.md as Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers.table.save(folder)
    text = markdown([*verdict(numbers), *summary_blocks(numbers), *detail_blocks(numbers)])
    (folder / "ratios.png").unlink(missing_ok=True)
    drawn = ratios_drawn(numbers)
    shown = [f"![{drawn[0]}]({save(drawn[1], folder / 'ratios.png').name})"] if drawn else []
    write_text(folder / "summary.md", "\n".join(["# Scores", "", text, *shown]) + "\n")
    return text


def detail_blocks(numbers: Compared) -> list[Block]:
    """Failures, settings that differ, costs."""
    cost = [cost_table(numbers)] if len(numbers.table.task("time")) else []
    return [*failure_blocks(numbers), *settings_table(numbers.table.runs, numbers.name), *cost]


def behind(table: ScoreTable, words: list[str], results: Path) -> Table:
    """The rows of the long table that match all words; a word is a scenario, method, seed, task or metric.

    Raises InputError if no row matches.
    """
    columns, rows = ["scenario", "method", "seed", "task", "metric"], table.rows
    headings = {metric.heading.lower(): name for name, metric in METRICS.items()}
    for word in words:
        known = rows[columns].astype(str)
        rows = rows[(known == headings.get(word.lower(), word)).any(axis=1)]
        if not len(rows):
            choices = " | ".join(f"{name}: {', '.join(known[name].unique())}" for name in columns)
            where, rule = f"explain {'/'.join(words)}", "every word must match a row of scores.csv"
            raise InputError(where, rule, word, f"Choose from {choices}.")
    shown = rows.merge(table.runs[["run", "status", "reason"]], on="run", how="left").drop(columns="category")
    shown = shown.assign(run=[str(results / name / "run.json") for name in shown["run"]])
    caption = f"Rows of scores.csv: {len(shown)} match {'/'.join(words)}"
    return Table.of_texts([*map(str, shown)], shown.itertuples(index=False), caption)
