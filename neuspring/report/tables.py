"""Queries on the long table, laid out: the verdict, averages, ratios, failures, costs. summary.md and report.html show the same."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from neuspring.config import Method
from neuspring.config.parse import read_rows
from neuspring.config.settings import Aim
from neuspring.core.files import write_text
from neuspring.core.table import Cell, Table, Tone
from neuspring.core.text import program
from neuspring.draw.benchmark import clusters_figure, ratios_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Code, Fold, Text, markdown
from neuspring.scores import queries, statistics
from neuspring.scores.metrics import DASH, METRICS, SHORT, Metric
from neuspring.scores.study import resolved
from neuspring.scores.table import ScoreTable, comparable, differing, mixed_settings, of_kind, pairs

TONES: dict[str, Tone] = {
    **dict.fromkeys((statistics.BELOW, statistics.REACHED, "better", "within", "same direction"), "good"),
    **dict.fromkeys((statistics.ABOVE, statistics.MISSED, "worse", "opposite", "failed"), "bad"),
}
"""Verdict -> its color; all others are muted."""
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
    results: Path | None = None
    """The folder of the runs, for commands to go on with; None without one."""
    asked: Mapping[str, Any] = field(default_factory=dict)
    """The last run of the workflow (`core.job_records.asked`)."""

    def name(self, method: str) -> str:
        """A method for people."""
        return self.names.get(method, method)


def shown_names(method_table: Path, extra: Iterable[Path] = ()) -> dict[str, str]:
    """Method -> title (`method`), of methods with a title; none without the file."""
    rows = read_rows(Method, method_table, "method", extra) if method_table.is_file() else {}
    return {name: f"{row.title} (`{name}`)" for name, row in rows.items() if row.title}


def several(count: int, noun: str) -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def pivot(caption: str, cells: pd.DataFrame, index: Mapping[str, str], note: str = "") -> Table:
    """A table with a column per task and metric.

    `cells` has the columns of `index` (column -> heading), task, metric and text; optional: value (sorts), mark, tone. Columns of
    `index` that are named with a trailing "_after" stand behind the values.
    """
    there = set(zip(cells["task"], cells["metric"], strict=True))
    columns = [(task, metric) for task in SHORT for metric in METRICS.values() if (task, metric.name) in there]
    before, after = ([name for name in index if name.endswith("_after") == behind] for behind in (False, True))
    rows = []
    for key, part in cells.groupby(list(index), sort=False):
        own = {(row["task"], row["metric"]): row for row in part.to_dict("records")}
        texts = dict(zip(index, key, strict=True))
        values = [_cell(own.get((task, metric.name), {})) for task, metric in columns]
        rows.append([*(Cell(text=str(texts[name])) for name in before), *values, *(Cell(text=str(texts[name])) for name in after)])
    heads = [f"{SHORT[task]} {metric.column} {'↑' if metric.higher_is_better else '↓'}" for task, metric in columns]
    header = [*(index[name] for name in before), *heads, *(index[name] for name in after)]
    return Table(caption=caption, header=header, rows=rows, note=note, stub=len(before))


def _cell(row: Mapping[Any, Any]) -> Cell:
    if not row:
        return Cell(text=DASH, value="", tone="mute")
    return Cell(text=row["text"], value=row.get("value"), mark=row.get("mark", ""), tone=row.get("tone", ""))


def texts(cells: pd.DataFrame, text: Callable[[Any, Metric], str]) -> pd.DataFrame:
    """The rows with a column `text`, by a function of row and metric."""
    return cells.assign(text=[text(row, METRICS[str(row.metric)]) for row in cells.itertuples()])


def best(cells: pd.DataFrame, value: str, by: tuple[str, ...] = ()) -> pd.DataFrame:
    """The rows with a column `mark`: the best value of each task and metric where there are several."""
    signs = cells["metric"].map(lambda name: -1.0 if METRICS[name].higher_is_better else 1.0)
    key = [cells[name] for name in ("task", "metric", *by)]
    signed = (signs * cells[value]).groupby(key)
    top = (signs * cells[value] == signed.transform("min")) & (signed.transform("count") > 1)
    return cells.assign(mark=top.map({True: "best", False: ""}))


def ratio_text(row: Any) -> str:
    """A ratio and its interval, the same wherever it is printed."""
    if pd.isna(row.ratio):
        return DASH
    return f"{row.ratio:.3f}" + ("" if pd.isna(row.ratio_low) else f" [{row.ratio_low:.3f}, {row.ratio_high:.3f}]")


def again(about: Mapping[str, Any], key: str = "", value: str = "") -> str:
    """The command of the last run of the workflow, with one setting changed; empty where that run is not known."""
    words = [word for word in about.get("command", ()) if not key or not word.startswith(f"{key}=")]
    if words and key:
        place = next((k + 1 for k, word in enumerate(words) if word in ("--config", "-C")), None)
        words[len(words) if place is None else place : place] = [*["--config"] * (place is None), f"{key}={value}"]
    return shlex.join(words)


def verdict(numbers: Compared) -> list[Block]:
    """Who is ahead, by how much, whether it is resolved; the table of all methods; commands to go on with."""
    runs, table = numbers.table.runs, queries.duels(numbers.table, numbers.baseline, numbers.objects)
    open_runs = (runs["status"] != "ok").any()
    moves = [("Finish what is missing; finished runs are kept:", again(numbers.asked))] if open_runs else []
    if not len(table):
        ended = int((runs["status"] == "ok").sum())
        return [Text(text=f"Nothing can be compared yet: {ended} of {len(runs)} runs have finished."), *_moves(moves)]
    first, metric = table.iloc[0], METRICS[table["metric"].iloc[0]]
    pair = table.iloc[1] if first["rival"] == "" and len(table) > 1 else first
    method, rival = numbers.name(pair["method"]), numbers.name(pair["rival"])
    seeds = runs["seed"].nunique()
    size = f"{several(runs['scenario'].nunique(), 'scenario')}, {several(seeds, 'seed')}"
    what = f"{SHORT[first['task']].lower()} {metric.title}, {size}"
    if not pair["rival"]:
        sentence = f"{method} is alone ({what})."
    else:
        ahead = {statistics.BELOW: method, statistics.ABOVE: rival}.get(pair["verdict"])
        size = f"{method} has {ratio_text(pair)} times the error of {rival} ({what}): {pair['verdict']}."
        sentence = f"{ahead} is ahead. {size}" if ahead else f"No method is ahead. {size}"
    if seeds == 1:
        moves.append(("Two more seeds show how much is chance in training:", again(numbers.asked, "seeds", "[0,1,2]")))
    if numbers.results:
        found = [
            sorted(numbers.results.glob(f"{first['worst']}/{name}/*/run.json"))[:1] for name in (first["method"], pair["rival"])
        ]
        if folders := dict.fromkeys(str(path.parent) for paths in found for path in paths):
            moves.append((f"Look at the worst scenario, {first['worst']}:", shlex.join([program("neuspring"), "play", *folders])))
    rows = []
    each: Iterator[Any] = table.itertuples()
    for row in each:
        counted = f"{row.better:.0f} of {row.of:.0f}" if row.rival else ""
        cells = [
            numbers.name(str(row.method)),
            metric.text(row.error),
            numbers.name(str(row.rival)),
            ratio_text(row) if row.rival else "",
        ]
        texts = [*cells, counted, f"{row.worst} ({metric.text(row.worst_error)})"]
        verdict = Cell(text=str(row.verdict), tone=TONES.get(str(row.verdict), "mute"))
        rows.append([*(Cell(text=text) for text in texts), verdict])
    header = [
        "Method",
        f"{SHORT[first['task']]} {metric.heading}",
        "Rival",
        "Ratio [95 %]",
        "Better in",
        "Worst scenario",
        "Resolved",
    ]
    note = f"{metric.shown_unit}, mean over scenarios. Ratio: geometric mean of paired ratios, t interval; per {numbers.objects}."
    return [Text(text=sentence, tone="lead"), Table(caption="Verdict", header=header, rows=rows, note=note), *_moves(moves)]


def _moves(moves: list[tuple[str, str]]) -> list[Block]:
    return [block for why, command in moves if command for block in (Text(text=why), Code(text=command, whole=True))]


def summary_blocks(numbers: Compared) -> list[Block]:
    """Averages, breakdowns, aims, ratios, differences, spreads."""
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
    ratios = statistics.ratios(finished, numbers.baseline, numbers.objects)
    if len(ratios):
        shown = texts(_named(numbers, ratios), lambda row, _: f"{ratio_text(row)} (n = {row.n}): {row.verdict}")
        shown = shown.assign(tone=shown["verdict"].map(lambda name: TONES.get(name, "")), value=shown["ratio"])
        note = "Geometric mean over objects of paired ratios, seeds averaged within an object; 95 % t interval over n objects "
        note += f"({numbers.objects}), none below {statistics.LEAST_OBJECTS}. All pairs that both methods finished."
        blocks.append(pivot(f"Ratio of the error to that of {numbers.name(numbers.baseline)}", shown, {"method": "Method"}, note))
    pictures = of_kind(usable, "pictures")
    if len(differences := statistics.paired_differences(pictures, numbers.baseline) if len(pictures) else pictures):
        shown = texts(_named(numbers, differences), _difference)
        note = "Same scenario and seed; 95 % bootstrap interval over scenarios and seeds, none for one scenario."
        blocks.append(pivot(f"Pictures: difference to {numbers.name(numbers.baseline)}", shown, {"method": "Method"}, note))
    if len(spread := statistics.seed_spread(finished)):
        shown = texts(_named(numbers, spread), lambda row, _: f"{100 * row.spread:.1f} %")
        blocks.append(
            pivot("Spread over seeds", shown, {"method": "Method"}, "Standard deviation of the log error, mean over scenarios.")
        )
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

    shown = best(means[~means["method"].isin(oracles)], "equal")
    shown = texts(pd.concat([shown, means[means["method"].isin(oracles)].assign(mark="")]), text).rename(columns={"equal": "value"})
    runs = {method: _runs(part["status"]) for method, part in table.runs.groupby("method", sort=False)}
    names = {method: f"{numbers.name(method)}{' (oracle)' * (method in oracles)}" for method in table.methods}
    order = {method: place for place, method in enumerate(table.methods)}
    shown = shown.sort_values("method", key=lambda column: column.map(order), kind="stable")
    shown = shown.assign(method=shown["method"].map(names), runs_after=shown["method"].map(runs))
    explained = "; ".join(f"{m.heading}: {m.explained or m.title}" for m in METRICS.values() if m.name in set(shown["metric"]))
    counts = ", ".join(several(table.runs[name].nunique(), name) for name in ("scenario", "seed"))
    note = f"{counts}; mean over scenarios"
    note += ", ± standard deviation over seeds" * spread_known + ", in brackets weighted by frames" * weighted + f". {explained}."
    note += {"positions": _floors(table), "pictures": _conditions(table)}.get(kind, "")
    return pivot(AVERAGED[kind], shown, {"method": "Method", "runs_after": "Runs"}, note)


def _runs(status: pd.Series) -> str:
    failed = int((status == "failed").sum())
    return f"{int((status == 'ok').sum())}/{len(status)}" + (f" ({failed} failed)" if failed else "")


def _floors(table: ScoreTable) -> str:
    """Errors in frame 0, which is given."""
    rows = table.task("start").drop_duplicates(["scenario", "metric"])
    known = [METRICS[name] for name in dict.fromkeys(rows["metric"]) if METRICS[name].paper_name]
    parts = [f"{metric.heading} {metric.text(rows.loc[rows['metric'] == metric.name, 'value'].mean())}" for metric in known]
    return f" In frame 0, which is given: {', '.join(parts)} mm." if parts else ""


def _conditions(table: ScoreTable) -> str:
    """How pictures were scored, from the runs' records."""
    facts = [fact for text in dict.fromkeys(table.runs["images"]) if (fact := json.loads(text))]
    parts = []
    for key in ("views", "masks", "backend", "lpips", "failed"):
        values = {", ".join(fact[key]) if isinstance(fact[key], list) else str(fact[key]) for fact in facts if key in fact}
        parts += [f"{key}: {' or '.join(sorted(values - {''}))}"] if values - {"", "computed"} else []
    return f" Conditions: {'; '.join(parts)}." if parts else ""


def _difference(row: Any, metric: Metric) -> str:
    if pd.isna(row.low):
        return metric.text(row.difference, "+")
    interval = f"[{metric.text(row.low, '+')}, {metric.text(row.high, '+')}]"
    return f"{metric.text(row.difference, '+')} {interval}: {resolved(row.low, row.high, row.scenarios, metric)}"


def _named(numbers: Compared, table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(method=table["method"].map(numbers.name))


def _breakdowns(numbers: Compared, finished: pd.DataFrame) -> Iterator[Fold]:
    """Per category and per scenario, of all finished runs, seeds averaged."""
    rows = of_kind(finished, "positions")
    counts = {column: rows[column].nunique() for column in ("category", "scenario")}
    for column, count in counts.items():
        if count > 1 and (column == "scenario" or count < counts["scenario"]):
            yield Fold(summary=f"Per {column}", blocks=[breakdown(_named(numbers, rows), column)], open=count <= 4)


def breakdown(rows: pd.DataFrame, column: str, method: str = "method", scale: bool = True) -> Table:
    """Means of finished runs per scenario or category; `scale`: values are in stored units."""
    each = rows.groupby([column, method, "task", "metric", "scenario"], sort=False)["value"].mean()
    means = each.groupby(level=[column, method, "task", "metric"], sort=False).mean().reset_index()
    shown = texts(best(means, "value", (column,)), lambda row, metric: (metric.text if scale else metric.shown)(row.value))
    return pivot(f"Per {column}", shown, {column: column.capitalize(), method: "Method"}, "All finished runs, seeds averaged.")


def _aims(numbers: Compared) -> Iterator[Table]:
    found = statistics.judged_aims(numbers.table.comparison.finished, numbers.aims, numbers.objects)
    rows = [
        [
            *(Cell(text=str(text)) for text in (numbers.name(row.method), numbers.name(row.baseline))),
            Cell(text=f"{SHORT[row.task]} {METRICS[row.metric].heading}"),
            Cell(text=f"<= {row.aim:.2f}, interval below {row.below:g}"),
            *(Cell(text=text) for text in (ratio_text(row), str(row.n))),
            Cell(text=row.aim_verdict, tone=TONES.get(row.aim_verdict, "mute")),
        ]
        for row in _rows(found)
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
        shown = _named(numbers, shown.sort_values("method", kind="stable"))
        note = "Mean over successful runs, and over all ended runs, where a failed prediction stays at its last finite frame."
        blocks.append(pivot("With failed runs", shown, {"method": "Method", "over": "Mean over"}, note))
    rows = []
    for (method, status, reason), part in table.runs[table.runs["status"] != "ok"].groupby(
        ["method", "status", "reason"], sort=False
    ):
        names = [f"{row.scenario}/{row.seed}" for row in _rows(part)]
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        rows.append((method, status, ", ".join(names[:MOST_NAMED]) + more, reason))
    for method, where in table.left_out.items():
        rows += [(method, "does not apply", name, why) for name, why in where.items()]
    if rows:
        made = [
            [
                Cell(text=numbers.name(str(m))),
                Cell(text=str(s), tone=TONES.get(str(s), "mute")),
                *(Cell(text=str(t), wrap=True) for t in rest),
            ]
            for m, s, *rest in rows
        ]
        blocks.append(Table(caption="Runs that do not count", header=["Method", "Status", "Scenario/seed", "Reason"], rows=made))
    return blocks


def notes_table(numbers: Compared) -> list[Table]:
    """Notes of the records, equal but for their numbers counted together."""
    notes = numbers.table.runs[numbers.table.runs["notes"] != ""]
    notes = notes.assign(note=notes["notes"].str.split("; ")).explode("note")
    notes = notes.assign(kind=notes["note"].str.replace(r"(?<![\w.])\d+(?:\.\d+)?(?!\w)", "…", regex=True))
    rows = [
        (numbers.name(str(method)), len(part), part["note"].iloc[0] if len(part) == 1 else kind)
        for (method, kind), part in notes.groupby(["method", "kind"], sort=False)
    ]
    return [Table.of_texts(["Method", "Runs", "Note"], rows, "Notes", "runs.csv has the notes of every run.")] if rows else []


def settings_table(runs: pd.DataFrame, names: Callable[[str], str]) -> list[Table]:
    """Settings that differ between methods, as the runs recorded them."""
    rows = []
    for setting, values in differing(runs).items():
        by_value: dict[str, list[str]] = {}
        for method in dict.fromkeys(runs["method"]):
            if method in values:
                by_value.setdefault(values[method], []).append(names(method))
        text = "; ".join(f"{value}: {', '.join(methods)}" for value, methods in by_value.items())
        rows.append([Cell(text=setting), Cell(text=text, wrap=True)])
    note = "As the runs recorded them. A stage that a method does not have is not listed for it."
    return [Table(caption="Settings that differ", header=["Setting", "Value: methods"], rows=rows, note=note)] if rows else []


def cost_table(numbers: Compared) -> Table:
    """Median wall time and peak memory of each stage per method."""
    time, memory = (
        numbers.table.task(task).pivot_table(index="method", columns="metric", values="value", aggfunc="median", sort=False)
        for task in ("time", "memory")
    )
    rows = []
    for method in time.index:
        own = [numbers.name(method)]
        for stage in time:
            seconds: Any = time.at[method, stage]
            megabytes: Any = memory.at[method, stage] if stage in memory and method in memory.index else float("nan")
            text = DASH if pd.isna(seconds) else f"{seconds:.1f} s"
            own.append(text if pd.isna(megabytes) else f"{text}, {megabytes:.0f} MB")
        rows.append(own)
    return Table.of_texts(["Method", *map(str, time)], rows, "Time and memory (medians)")


def figures(numbers: Compared) -> Iterator[tuple[str, str, Figure]]:
    """File, caption and figure: ratios with their intervals, and the error against the number of regions."""
    ratios = statistics.ratios(numbers.table.comparison.finished, numbers.baseline, numbers.objects)
    # Figures show no backticks.
    plain = _named(numbers, ratios).replace("`", "", regex=True)
    if figure := ratios_figure(plain, numbers.name(numbers.baseline).replace("`", "")):
        yield "ratios.png", f"Ratio of every method's errors to those of {numbers.name(numbers.baseline)}", figure
    of_clusters = [name for name in numbers.table.methods if re.fullmatch(r"model_b|clusters_\d+", name)]
    if figure := clusters_figure(comparable(numbers.table.of(of_clusters).finished)):
        yield "clusters.png", "Chamfer distance against the number of regions K", figure


def write(numbers: Compared, folder: Path) -> str:
    """Write scores.csv, runs.csv, summary.md and its figures; returns the text of the summary."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers.table.save(folder)
    text = markdown([*verdict(numbers), *summary_blocks(numbers), *detail_blocks(numbers)])
    for name in ("ratios.png", "clusters.png"):
        (folder / name).unlink(missing_ok=True)
    shown = [f"![{caption}]({save(figure, folder / name).name})" for name, caption, figure in figures(numbers)]
    write_text(folder / "summary.md", "\n".join(["# Scores", "", text, *shown]) + "\n")
    return text


def detail_blocks(numbers: Compared) -> list[Block]:
    """Failures, settings that differ, notes, costs."""
    settings = settings_table(numbers.table.runs, numbers.name)
    cost = [cost_table(numbers)] if len(numbers.table.task("time")) else []
    return [*failure_blocks(numbers), *settings, *notes_table(numbers), *cost]


def behind(table: ScoreTable, words: list[str], results: Path) -> Table:
    """The rows of the long table behind a number: those that every word names by scenario, method, seed, task or metric."""
    rows = table.rows.merge(table.runs[["run", "status", "reason"]], on="run", how="left")
    headings = {metric.heading.lower(): name for name, metric in METRICS.items()}
    for word in words:
        chosen = headings.get(word.lower(), word)
        kept = rows[(rows[["scenario", "method", "task", "metric"]] == chosen).any(axis=1) | (rows["seed"].astype(str) == chosen)]
        if not len(kept):
            from neuspring.core.errors import InputError

            known = [
                f"{name}: {', '.join(map(str, dict.fromkeys(table.rows[name])))}"
                for name in ("scenario", "method", "task", "metric")
            ]
            raise InputError(f"explain {'/'.join(words)}", "must name rows of scores.csv", word, " | ".join(known))
        rows = kept
    texts = [
        [row.scenario, row.method, row.seed, row.task, row.metric, f"{row.value:.6g} {row.unit}", row.frames, f"{row.status}"
         + (f": {row.reason}" if row.reason else ""), results / row.run / "run.json"]
        for row in _rows(rows)
    ]  # fmt: skip
    header = ["Scenario", "Method", "Seed", "Task", "Metric", "Value", "Frames", "Status", "Record"]
    return Table.of_texts(header, texts, f"{len(texts)} rows behind {'/'.join(words) or 'all numbers'}")
