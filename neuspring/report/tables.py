"""Queries on the long table, laid out: the verdict, averages, ratios, failures, costs. summary.md and report.html show the same."""

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
"""Verdict -> its color; all others are muted."""
ARROWS = {"higher": "↑", "lower": "↓", "neither": ""}
CONDITIONS = ("views", "masks", "backend", "lpips", "failed")
"""Facts of the pictures' scores that tables state."""
AVERAGED = {"positions": "Errors, mm", "pictures": "Scores of pictures", "marks": "Points marked in images"}
MOST_NAMED = 6


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A long table and what its tables compare."""

    table: ScoreTable
    baseline: str
    objects: statistics.Objects = "scenario"
    aims: tuple[Aim, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    """Method -> its name for people, of those that have one."""

    def name(self, method: str) -> str:
        """A method for people."""
        return self.names.get(method, method)

    def named(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Rows whose methods have their names for people."""
        return rows.assign(method=rows["method"].map(self.name))


def shown_names(method_table: Path, extra: Iterable[Path] = ()) -> dict[str, str]:
    """Method -> title (`method`), of methods with a title; none without the file."""
    rows = read_rows(Method, method_table, "method", extra) if method_table.is_file() else {}
    return {name: f"{row.title} (`{name}`)" for name, row in rows.items() if row.title}


def several(count: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def judged(*texts: object, verdict: str) -> list[Cell]:
    """The cells of a row whose last one is a verdict in its color."""
    return [*(Cell(text=str(text)) for text in texts), Cell(text=verdict, tone=TONES.get(verdict, "mute"))]


def pivot(caption: str, cells: pd.DataFrame, index: Mapping[str, str], note: str = "") -> Table:
    """A table with a column per task and metric.

    `cells` has the columns of `index` (column -> heading), task, metric and text; optional: value (sorts), mark, tone.
    """
    there = present(cells)
    columns = [(task, metric) for task in SHORT for metric in METRICS.values() if (task, metric.name) in there]
    rows = []
    for key, part in cells.groupby(list(index), sort=False):
        own = {(row["task"], row["metric"]): row for row in part.to_dict("records")}
        rows.append(
            [*(Cell(text=str(text)) for text in key), *(_cell(own.get((task, metric.name), {})) for task, metric in columns)]
        )
    heads = [f"{SHORT[task]} {metric.column} {ARROWS[metric.better]}".rstrip() for task, metric in columns]
    return Table(caption=caption, header=[*index.values(), *heads], rows=rows, note=note, stub=len(index))


def _cell(row: Mapping[Any, Any]) -> Cell:
    if not row:
        return Cell(text=DASH, value="", tone="mute")
    return Cell(text=row["text"], value=row.get("value"), mark=row.get("mark", ""), tone=row.get("tone", ""))


def texts(cells: pd.DataFrame, text: Callable[[Any, Metric], str]) -> pd.DataFrame:
    """The rows with a column `text`, by a function of row and metric."""
    return cells.assign(text=[text(row, METRICS[str(row.metric)]) for row in cells.itertuples()])


def best(cells: pd.DataFrame, value: str, by: tuple[str, ...] = ()) -> pd.DataFrame:
    """The rows with a column `mark`: the best value of each task and metric where there are several and one direction is better."""
    signs = cells["metric"].map(lambda name: {"higher": -1.0, "lower": 1.0}.get(METRICS[name].better, np.nan))
    key = [cells[name] for name in ("task", "metric", *by)]
    signed = (signs * cells[value]).groupby(key)
    top = (signs * cells[value] == signed.transform("min")) & (signed.transform("count") > 1)
    return cells.assign(mark=top.map({True: "best", False: ""}))


def ratio_text(row: Any) -> str:
    """A ratio and its interval, the same wherever it is printed."""
    if pd.isna(row.ratio):
        return DASH
    return f"{row.ratio:.3f}" + ("" if pd.isna(row.ratio_low) else f" [{row.ratio_low:.3f}, {row.ratio_high:.3f}]")


def change_text(row: Any, metric: Metric, scale: bool = True) -> str:
    """A row of `statistics.changes`: a ratio of errors, a difference of pictures, with its interval."""
    text = metric.text if scale else metric.shown
    show = "{:.3f}".format if metric.is_error else lambda value: text(value, "+")
    interval = f" [{show(row.change_low)}, {show(row.change_high)}]" if pd.notna(row.change_low) else ""
    return DASH if pd.isna(row.change) else f"{show(row.change)}{interval}"


def verdict(numbers: Compared) -> list[Block]:
    """Who is ahead, by how much, whether it is resolved; the table of all methods."""
    runs, table = numbers.table.runs, queries.duels(numbers.table, numbers.baseline, numbers.objects)
    if not len(table):
        ended = int((runs["status"] == "ok").sum())
        return [Text(text=f"Nothing can be compared yet: {ended} of {len(runs)} runs have finished.")]
    first, metric = table.iloc[0], METRICS[table["metric"].iloc[0]]
    pair = table.iloc[1] if first["rival"] == "" and len(table) > 1 else first
    method, rival = numbers.name(pair["method"]), numbers.name(pair["rival"])
    counts = ", ".join(several(runs[name].nunique(), name) for name in ("scenario", "seed"))
    what = f"({SHORT[first['task']].lower()} {metric.title}, {counts})"
    ahead = {statistics.BELOW: method, statistics.ABOVE: rival}.get(pair["verdict"], "No method")
    sentence = f"{ahead} is ahead. {method} has {ratio_text(pair)} times the error of {rival} {what}: {pair['verdict']}."
    rows = [
        judged(
            numbers.name(str(row.method)),
            metric.text(row.error),
            numbers.name(str(row.rival)),
            ratio_text(row) if row.rival else "",
            f"{row.better:.0f} of {row.of:.0f}" if row.rival else "",
            f"{row.worst} ({metric.text(row.worst_error)})",
            verdict=row.verdict,
        )
        for row in _rows(table)
    ]
    error = f"{SHORT[first['task']]} {metric.heading}"
    header = ["Method", error, "Rival", "Ratio [95 %]", "Better in", "Worst scenario", "Resolved"]
    note = f"{metric.shown_unit}, mean over scenarios. Ratio: geometric mean of paired ratios, t interval; per {numbers.objects}."
    lead = sentence if pair["rival"] else f"{method} is alone {what}."
    return [Text(text=lead, tone="lead"), Table(caption="Verdict", header=header, rows=rows, note=note)]


def summary_blocks(numbers: Compared) -> list[Block]:
    """Averages, breakdowns, aims, changes against the baseline."""
    table, compared = numbers.table, numbers.table.comparison
    usable, finished = comparable(compared.finished), compared.finished
    blocks: list[Block] = []
    if mixed := mixed_settings(table.runs):
        text = f"Runs of one method were made with different settings ({', '.join(mixed)}): make the older ones again."
        blocks.append(Text(text=text, tone="warn"))
    if pairs(usable) < pairs(compared.runs):
        text = f"Averages take the {pairs(usable)} of {pairs(compared.runs)} pairs of scenario and seed that every method finished."
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
            "Errors: geometric mean over objects of paired ratios, seeds averaged within an object; 95 % t interval over objects "
        )
        note += f"({numbers.objects}), none below {statistics.LEAST_OBJECTS}. Others: difference, 95 % bootstrap interval over "
        note += "scenarios and seeds. All pairs that both methods finished."
        blocks.append(pivot(f"Change against {numbers.name(numbers.baseline)}", shown, {"method": "Method"}, note))
    return blocks


def average_table(numbers: Compared, kind: str) -> Table:
    """Mean scores of every method for metrics of positions, pictures or marks; oracles are named."""
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
    explained = "; ".join(f"{m.heading}: {m.explained or m.title}" for m in METRICS.values() if m.name in set(shown["metric"]))
    counts = ", ".join(several(table.runs[name].nunique(), name) for name in ("scenario", "seed"))
    note = f"{counts}; mean over scenarios"
    note += ", ± standard deviation over seeds" * spread_known + ", in brackets weighted by frames" * weighted + f". {explained}."
    note += _conditions(table) if kind == "pictures" else ""
    return pivot(AVERAGED[kind], shown, {"method": "Method", "runs": "Runs"}, note)


def _runs(status: pd.Series) -> str:
    failed = int((status == "failed").sum())
    return f"{int((status == 'ok').sum())}/{len(status)}" + (f" ({failed} failed)" if failed else "")


def _conditions(table: ScoreTable) -> str:
    """How pictures were scored, from the runs' records."""
    facts = [fact for text in dict.fromkeys(table.runs["images"]) if (fact := json.loads(text))]
    values = {
        key: {", ".join(np.atleast_1d(fact[key]).astype(str)) for fact in facts if fact.get(key, "") not in ("", "computed")}
        for key in CONDITIONS
    }
    parts = [f"{key}: {' or '.join(sorted(own))}" for key, own in values.items() if own]
    return f" Conditions: {'; '.join(parts)}." if parts else ""


def _breakdowns(numbers: Compared, finished: pd.DataFrame) -> Iterator[Fold]:
    """Per category and per scenario, of all finished runs, seeds averaged."""
    rows = of_kind(finished, "positions")
    counts = {column: rows[column].nunique() for column in ("category", "scenario")}
    for column, count in counts.items():
        if count > 1 and (column == "scenario" or count < counts["scenario"]):
            yield Fold(summary=f"Per {column}", blocks=[breakdown(numbers.named(rows), column)], open=count <= 4)


def breakdown(rows: pd.DataFrame, column: str, method: str = "method", scale: bool = True) -> Table:
    """Means of finished runs per scenario or category; `scale`: values are in stored units."""
    each = rows.groupby([column, method, "task", "metric", "scenario"], sort=False)["value"].mean()
    means = each.groupby(level=[column, method, "task", "metric"], sort=False).mean().reset_index()
    shown = texts(best(means, "value", (column,)), lambda row, metric: (metric.text if scale else metric.shown)(row.value))
    return pivot(f"Per {column}", shown, {column: column.capitalize(), method: "Method"}, "All finished runs, seeds averaged.")


def _aims(numbers: Compared) -> Iterator[Table]:
    rows = [
        judged(
            numbers.name(row.method),
            numbers.name(row.baseline),
            f"{SHORT[row.task]} {METRICS[row.metric].heading}",
            f"<= {row.aim:.2f}, interval below {row.below:g}",
            ratio_text(row),
            row.n,
            verdict=row.aim_verdict,
        )
        for row in _rows(statistics.judged_aims(numbers.table.comparison.finished, numbers.aims, numbers.objects))
    ]
    if rows:
        header = ["Method", "Against", "What", "Aim", "Ratio [95 %]", "n", "Verdict"]
        yield Table(caption="Aims of the configuration", header=header, rows=rows)


def _rows(table: pd.DataFrame) -> list[Any]:
    return list(table.itertuples())


def failure_blocks(numbers: Compared, scale: bool = True) -> list[Block]:
    """Means without and with failed runs; runs that do not count, by reason; scenarios that methods do not apply to."""
    table, blocks = numbers.table, list[Block]()
    if len(found := queries.with_failures(table.comparison)):
        lines = [
            found.assign(over=over, shown=found[column]) for column, over in (("own", "successes"), ("all", "all, failed held"))
        ]
        shown = texts(pd.concat(lines), lambda row, metric: (metric.text if scale else metric.shown)(row.shown))
        note = "Mean over successful runs, and over all ended runs, where a failed prediction stays at its last finite frame."
        index = {"method": "Method", "over": "Mean over"}
        blocks.append(pivot("With failed runs", numbers.named(shown.sort_values("method", kind="stable")), index, note))
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
        blocks.append(Table(caption="Runs that do not count", header=["Method", "Status", "Scenario/seed", "Reason"], rows=made))
    return blocks


def settings_table(runs: pd.DataFrame, names: Callable[[str], str]) -> list[Table]:
    """Settings that differ between methods, as the runs recorded them."""
    rows = []
    for setting, values in differing(runs).items():
        by_value: dict[str, list[str]] = {}
        for method in (name for name in dict.fromkeys(runs["method"]) if name in values):
            by_value.setdefault(values[method], []).append(names(method))
        text = "; ".join(f"{value}: {', '.join(methods)}" for value, methods in by_value.items())
        rows.append([Cell(text=setting), Cell(text=text, wrap=True)])
    note = "As the runs recorded them. A stage that a method does not have is not listed for it."
    return [Table(caption="Settings that differ", header=["Setting", "Value: methods"], rows=rows, note=note)] if rows else []


def cost_table(numbers: Compared) -> Table:
    """Median wall time, peak memory and epochs of each stage per method, and whether half of its fits have converged."""
    units = {"time": "{:.1f} s", "memory": "{:.0f} MB", "epochs": "{:.0f} epochs", "converged": "{:.0%} converged"}
    rows = numbers.table.task(*units).groupby(["method", "metric", "task"], sort=False)["value"].median()
    stages = list(dict.fromkeys(rows.index.get_level_values("metric")))
    known, made = rows.to_dict(), []
    for method in dict.fromkeys(rows.index.get_level_values("method")):
        keys = [[((method, stage, task), unit) for task, unit in units.items()] for stage in stages]
        parts = [", ".join(unit.format(known[key]) for key, unit in own if key in known) for own in keys]
        made.append([numbers.name(method), *(part or DASH for part in parts)])
    return Table.of_texts(["Method", *stages], made, "Time, memory, epochs (medians)")


def ratios_drawn(numbers: Compared) -> tuple[str, Figure] | None:
    """Caption and figure of ratios with their intervals; None without any."""
    ratios = statistics.ratios(numbers.table.comparison.finished, numbers.baseline, numbers.objects)
    # Figures show no backticks.
    figure = ratios_figure(numbers.named(ratios).replace("`", "", regex=True), numbers.name(numbers.baseline).replace("`", ""))
    return (f"Ratio of every method's errors to those of {numbers.name(numbers.baseline)}", figure) if figure else None


def write(numbers: Compared, folder: Path) -> str:
    """Write scores.csv, runs.csv, summary.md and its figures; returns the text of the summary."""
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
    """The rows of the long table behind a number: those that every word names by scenario, method, seed, task or metric."""
    columns, rows = ["scenario", "method", "seed", "task", "metric"], table.rows
    headings = {metric.heading.lower(): name for name, metric in METRICS.items()}
    for word in words:
        known = rows[columns].astype(str)
        rows = rows[(known == headings.get(word.lower(), word)).any(axis=1)]
        if not len(rows):
            there = " | ".join(f"{name}: {', '.join(known[name].unique())}" for name in columns)
            raise InputError(f"explain {'/'.join(words)}", "must name rows of scores.csv", word, there)
    shown = rows.merge(table.runs[["run", "status", "reason"]], on="run", how="left").drop(columns="category")
    shown = shown.assign(run=[str(results / name / "run.json") for name in shown["run"]])
    return Table.of_texts([*map(str, shown)], shown.itertuples(index=False), f"{len(shown)} rows behind {'/'.join(words)}")
