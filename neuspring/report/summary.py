"""A benchmark's numbers laid out: averages, ratios and aims, failures, pictures, transfers, breakdowns.

`summary.md` and `report.html` show the same.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuspring.core.files import write_text
from neuspring.core.table import Cell, Table
from neuspring.draw.benchmark import cluster_methods, clusters_figure, ratios_figure
from neuspring.draw.sheet import save
from neuspring.report.blocks import Block, Fold, Items, Text, markdown
from neuspring.report.grid import EMPTY, Columns, best, between, by_method, chip, columns, flat, grouped, ratio_text, rows
from neuspring.report.notes import honest_notes
from neuspring.report.verdict import NOUNS, verdict
from neuspring.scores import failures, statistics
from neuspring.scores.metrics import DASH, METRICS, SCORE_COLUMNS, SHORT, Metric, metrics_of
from neuspring.scores.numbers import Numbers
from neuspring.scores.runs import Collected, comparable, mixed_settings, pairs
from neuspring.scores.study import ORACLE_LINE

NOT_COMPUTED = Cell(text="not computed", value="")
MOST_OPEN_ROWS = 12
"""Most rows of a breakdown that is not folded."""
LISTED = 12
"""At most so many notes are listed one by one. If there are more, they are counted by kind."""
MOST_NAMED = 6
"""At most so many runs with the same reason are named. runs.csv and numbers.json have all."""
NUMBER = r"(?<![\w.])\d+(?:\.\d+)?(?!\w)"
"""A number of a note: notes that differ in numbers alone are of one kind."""
HOLE = "\ufffc"
"""Stands for a number in a kind of note."""
DIFFERING = (
    "Settings that differ between the rows, as the runs recorded them. A stage that a row does not have is not listed for it."
)
SHORT_NAMES = {"NSF": "neural spring field", "PT": "piecewise topology"}
"""Abbreviations in names of methods."""


def score_blocks(numbers: Numbers) -> list[Block]:
    """Averages of all methods, aims, per scenario and category, pictures, marked points, twins on other recordings."""
    usable, runs = numbers.usable, numbers.collected.runs
    blocks: list[Block] = []
    if warning := mixed_settings(runs):
        blocks.append(Text(text=warning, tone="warn"))
    if removed := failures.removed_lines(runs, numbers.collected.left_out, numbers.labels):
        kept = f"Averages take {pairs(usable)} of {pairs(runs)} pairs of scenario and seed, those that every method finished."
        nothing = "No pair of scenario and seed was finished by every method, so there is no average of all methods."
        blocks.append(Text(text=" ".join([kept if len(usable) else nothing, *removed])))
    if not len(usable) and not (runs["status"] == "ok").any():
        blocks.append(Text(text="No run has finished, so there is nothing to average.", tone="mute"))
    blocks += [errors_table(numbers), *aim_table(_named(numbers.aimed, numbers))]
    blocks += breakdown_blocks(_named(numbers.finished, numbers))
    return [*blocks, *image_blocks(numbers), *marked_blocks(numbers), *transfer_blocks(numbers)]


def detail_blocks(numbers: Numbers) -> list[Block]:
    """Certainty of the averages: floors, spread, ratios, failures, and what to be careful with."""
    everyone, baseline = numbers.everything.runs, numbers.name(numbers.baseline)
    blocks: list[Block] = [Text(text=line) for line in floor_lines(numbers.floors)]
    if len(spread := _named(numbers.seeds, numbers)):
        about = "Standard deviation of the log error, in per cent, mean over scenarios."
        shown = columns(spread)
        blocks.append(by_method("Spread over seeds", spread, shown, lambda row, _: Cell(text=f"{100 * row.spread:.1f} %"), about))
    blocks += ratio_table(f"Ratio of the error to that of {baseline}", numbers)
    blocks += difference_table(f"Pictures: paired difference to {baseline}", _named(numbers.differences, numbers))
    if len(numbers.held):
        methods = {name: numbers.name(name) for name in dict.fromkeys(numbers.held["method"])}
        shown = columns(numbers.held, ["positions", "pictures"])
        table = failure_table("Failures (errors in mm)", numbers.held, methods, shown)
        blocks += [table, *(Text(text=text, tone="warn") for text in failures.unknown_lines(numbers.held, numbers.labels))]
    blocks += settings_table(numbers.settings)
    blocks += [Text(text=line) for line in failures.left_out_lines(numbers.collected.left_out, numbers.labels)]
    if honest := honest_notes(numbers.everything):
        blocks.append(Items(title="Of your own recordings", items=honest))
    if len(noted := everyone[everyone["notes"] != ""]):
        blocks.append(Items(title="Notes", items=_notes(noted, everyone["method"].value_counts())))
    return blocks


def _named(table: pd.DataFrame, numbers: Numbers) -> pd.DataFrame:
    """The table with its methods as people read them."""
    names = {column: table[column].map(numbers.name) for column in ("method", "baseline") if column in table}
    return table.assign(**names)


def errors_table(numbers: Numbers) -> Table:
    """Mean errors of every method; oracles stand below a line of their own, on the pairs that count."""
    runs, shown = numbers.collected.runs, columns(numbers.usable, always=True)
    scenarios, seeds = runs["scenario"].nunique(), runs["seed"].nunique()
    size = f"{scenarios} scenario{'s' * (scenarios > 1)}, {seeds} seed{'s' * (seeds > 1)}"
    used = dict.fromkeys(metric for _, metric in shown)
    names = " ".join(map(numbers.name, runs["method"].unique()))
    short = {metric.heading: metric.explained or metric.title for metric in used}
    short |= {name: told for name, told in SHORT_NAMES.items() if re.search(rf"\b{name}\b", names)}
    explained = "; ".join(f"{name}: {told}" for name, told in short.items())
    spread = ", ± standard deviation over seeds" if _several_seeds(numbers.usable) else ""
    weighted = "; in brackets the frame-weighted mean" if _weighted(numbers.usable) else ""
    note = f"In mm, lower is better ({size}; {explained}). Mean over scenarios{spread}{weighted}. Best in bold."
    lines = average_rows(numbers, numbers.usable, runs, runs, shown)
    oracles = numbers.everything.of(numbers.everything.oracles).runs
    if len(oracles):
        lines.append([Cell(text=ORACLE_LINE), *[Cell()] * (len(shown) + 1)])
        lines += average_rows(numbers, numbers.usable, oracles, oracles, shown, marked=False)
    return flat("Errors, mm", ["Method"], shown, lines, "Runs", note=note, sortable=True)


def average_rows(
    numbers: Numbers,
    scores: pd.DataFrame,
    runs: pd.DataFrame,
    counted: pd.DataFrame,
    shown: Columns,
    absent: Cell = EMPTY,
    *,
    marked: bool = True,
) -> list[list[Cell]]:
    """Both averages of every method of `runs`, and how many of its runs in `counted` finished; `absent` stands for no value.

    `scores` say whether there are several seeds, and scenarios of different lengths.
    """
    several, weighted, averages = _several_seeds(scores), _weighted(scores), numbers.averages
    own: list[Any] = list(averages[averages["method"].isin(runs["method"])].itertuples())
    tops = best((row.task, row.metric, row.equal) for row in own) if marked else {}
    means = {(row.method, row.task, row.metric): row for row in own}

    def cell(row: Any, metric: Metric) -> Cell:
        spread = f" ± {metric.text(row.seed_std)}" if several else ""
        frames = [f"({metric.text(row.frames)})"] if weighted else []
        top = row.equal == tops.get((row.task, row.metric))
        return Cell(text=metric.text(row.equal) + spread, small=frames, value=row.equal, mark="best" if top else "")

    lines = []
    for method in dict.fromkeys(runs["method"]):
        here = [(means.get((method, task, metric.name)), metric) for task, metric in shown]
        status = counted.loc[counted["method"] == method, "status"].value_counts().to_dict()
        failed = f" ({status['failed']} failed)" if status.get("failed") else ""
        text, tone = f"{status.get('ok', 0)}/{sum(status.values())}{failed}", "bad" if failed else ""
        values = [cell(row, metric) if row else absent for row, metric in here]
        lines.append([Cell(text=numbers.name(str(method))), *values, Cell(text=text, tone=tone, value=status.get("ok", 0))])  # type: ignore[arg-type]
    return lines


def ratio_table(caption: str, numbers: Numbers) -> list[Table]:
    """Ratios with intervals over objects and verdicts; nothing without any."""
    if not len(numbers.ratios):
        return []

    def cell(row: Any, _: Metric) -> Cell:
        return Cell(text=ratio_text(row), small=[f"(n = {row.n})"], chips=[chip(row.verdict)], value=float(row.ratio))

    note = (
        f"Geometric mean over objects of the paired ratio to {numbers.name(numbers.baseline)}, seeds averaged within an object; "
        f"95 % t-interval over objects ({NOUNS[numbers.objects]}), none below {statistics.LEAST_OBJECTS}; n objects. Every row "
        "takes all pairs of scenario and seed that both methods finished."
    )
    return [by_method(caption, _named(numbers.ratios, numbers), columns(numbers.ratios), cell, note)]


def aim_table(aims: pd.DataFrame) -> list[Table]:
    """A line per aim: what was aimed at, what was measured, reached or missed. Nothing without aims."""
    lines, each = [], cast("Any", aims.itertuples())
    for row in each:
        what = f"{SHORT[str(row.task)]} {METRICS[str(row.metric)].heading}"
        ratio = ratio_text(row) if np.isfinite(row.ratio) else DASH
        texts = [row.method, row.baseline, what, f"<= {row.aim:.2f}, interval below {row.below:g}", ratio, row.n]
        lines.append([*(Cell(text=str(text)) for text in texts), Cell(chips=[chip(str(row.aim_verdict))])])
    header = ["Method", "Against", "What", "Aim", "Ratio [95 % interval]", "n", "Verdict"]
    return [Table(caption="Aims, declared in the configuration", header=header, rows=lines)] if lines else []


def difference_table(caption: str, differences: pd.DataFrame) -> list[Table]:
    """Paired differences of scores of pictures, with intervals and verdicts; nothing without any."""

    def cell(row: Any, metric: Metric) -> Cell:
        interval = between(row.low, row.high, lambda value: metric.text(value, "+"))
        small, chips = ([interval], [chip(row.verdict)]) if interval else ([], [])
        return Cell(text=metric.text(row.difference, "+"), small=small, chips=chips, value=float(row.difference))

    note = "Same scenario and seed; 95 % bootstrap interval over scenarios and seeds, none for a single scenario."
    return [by_method(caption, differences, columns(differences, ["pictures"]), cell, note)] if len(differences) else []


def failure_table(caption: str, means: pd.DataFrame, labels: Mapping[str, str], shown: Columns, scale: bool = True) -> Table:
    """For every method (with its label) its means over its successes and over all its runs, in brackets the other average.

    `scale`: the means are in stored units, not in those of tables.
    """

    def lines(row: Any) -> list[tuple[list[Cell], Any]]:
        lost = row.succeeded < row.attempted
        count = Cell(text=f"{row.succeeded}/{row.attempted}", tone="bad" if lost else "")
        over = [(failures.OWN, "own"), (failures.ALL, "all")] if lost else [("all", "own")]
        stubs = [[Cell(text=labels[row.method]), count], [Cell(), Cell()]]
        return [([*stub, Cell(text=text)], show(column)) for stub, (text, column) in zip(stubs, over, strict=False)]

    def show(column: str) -> Any:
        def cell(row: Any, metric: Metric) -> Cell:
            mean, other = getattr(row, column), getattr(row, f"{column}_other")
            text = metric.text if scale else metric.shown
            return EMPTY if pd.isna(mean) else Cell(text=text(mean), small=[f"({text(other)})"])

        return cell

    ordered = pd.concat([means[means["method"] == method] for method in labels])
    brackets = "In brackets the other average: weighted by frames for errors, equally for pictures."
    note = f"{failures.FAILURE_NOTE} {brackets} {failures.DASH_NOTE}"
    stub = ["Method", "Succeeded", "Mean over"]
    made = rows(ordered, shown, ["method"], lines)
    return flat(caption, stub, shown, made, note=note) if scale else grouped(caption, stub, shown, made, note)


def settings_table(differing: pd.DataFrame) -> list[Table]:
    """The settings that differ between methods; nothing where none does."""
    lines = [[Cell(text=name), Cell(text=text, wrap=True)] for name, text in differing.itertuples(index=False)]
    return [Table(caption="Settings that differ", header=["Setting", "Value: rows"], rows=lines, note=DIFFERING)] if lines else []


def floor_lines(floors: pd.DataFrame) -> list[str]:
    """The errors in frame 0, which is given: mean over scenarios, and the range. Nothing where records do not have them."""
    parts = []
    for metric in metrics_of("positions"):
        values = floors.loc[floors["metric"] == metric.name, "value"]
        if len(values) and metric.paper_name:
            spread = f" ({metric.text(values.min())} to {metric.text(values.max())})" if len(values) > 1 else ""
            parts.append(f"{metric.heading} {metric.text(values.mean())} mm{spread}")
    if not parts:
        return []
    of = f", mean of {count} scenarios (least to largest)" if (count := floors["scenario"].nunique()) > 1 else ""
    text = f"Floor in frame 0{of}: {', '.join(parts)}; TE bound 0 by construction."
    return [f"{text} A floor is no motion: it is how far points are from nodes."]


def image_blocks(numbers: Numbers) -> list[Block]:
    """Conditions of the scores of pictures, and both averages; a sentence if there are none."""
    collected, scores = numbers.collected, numbers.usable
    facts = [json.loads(text) if isinstance(text, str) else None for text in collected.runs.get("images", [])]
    runs = collected.runs[[bool(fact) for fact in facts] or [False] * len(collected.runs)]
    runs = runs.assign(images=[fact for fact in facts if fact])
    if not len(runs):
        return [Text(text="No scores of pictures: these scenarios have no images, or images.enabled is off.")]
    rendered = runs[["failed" not in facts for facts in runs["images"]]]
    shown = columns(scores, ["pictures"])
    if not len(rendered) or not shown:
        reasons = sorted({str(facts["failed"]) for facts in runs["images"] if "failed" in facts})
        return [Text(text=f"No scores of pictures: {'; '.join(reasons) or 'no run that can be compared has them'}.")]
    pictured = scores[scores["metric"].isin([metric.name for _, metric in shown])]
    have, asked = pictured["scenario"].nunique(), collected.runs["scenario"].nunique()
    some = "" if have == asked else f"Of {asked} scenarios {have} have scores of pictures. "
    weighted = "; in brackets the frame-weighted mean" if _weighted(pictured) else ""
    note = (
        f"Higher is better; LPIPS: lower; PSNR in dB. {some}{_image_conditions(rendered['images'])} Mean over scenarios{weighted}."
    )
    lines = average_rows(numbers, pictured, collected.runs, runs, shown, NOT_COMPUTED)
    blocks: list[Block] = [flat("Scores of pictures", ["Method"], shown, lines, "Runs", note=note, sortable=True)]
    blocks.append(Text(text=f"Part of the surface that no camera sees in frame 0: {_unseen(rendered)}."))
    where = "in some runs " if "lpips" in set(pictured["metric"]) else ""
    reasons = sorted({str(facts["lpips"]) for facts in rendered["images"]} - {"computed"})
    return [*blocks, *(Text(text=f"LPIPS {where}not computed: {reason}") for reason in reasons)]


def _unseen(runs: pd.DataFrame) -> str:
    """Scenarios and the share of their surface that frame 0 hides, in words."""
    shares: dict[str, list[float | None]] = {}
    for scenario, facts in zip(runs["scenario"], runs["images"], strict=True):
        shares.setdefault(str(scenario), []).append(facts["unseen_surface"])
    numbers = {name: [value for value in values if value is not None] for name, values in shares.items()}
    return ", ".join(f"{name} {f'{np.mean(v):.0%}' if v else 'unknown (no shape prior)'}" for name, v in numbers.items())


def _image_conditions(facts: Iterable[dict[str, Any]]) -> str:
    """Conditions of the scores of pictures, from the runs' records."""

    def several(name: str) -> str:
        return " and ".join(sorted({", ".join(v) if isinstance(v := values[name], list) else str(v) for values in facts}))

    return f"Cameras scored: {several('views')}; masks: {several('masks')}; rasterizer: {several('backend')}."


def marked_blocks(numbers: Numbers) -> list[Block]:
    """Errors of points that were marked in images; nothing where there are none."""
    scores, runs = numbers.usable, numbers.collected.runs
    if not (shown := columns(scores, ["marks"])):
        return []
    own = scores[scores["metric"].isin([metric.name for _, metric in shown])]
    have, asked = own["scenario"].nunique(), runs["scenario"].nunique()
    note = f"{have} of {asked} scenarios, lower is better: px in the image; mm on the table."
    lines = average_rows(numbers, own, runs, runs[runs["scenario"].isin(own["scenario"])], shown)
    return [flat("Points marked in images", ["Method"], shown, lines, "Runs", note=note)]


def transfer_blocks(numbers: Numbers) -> list[Block]:
    """Twins on other recordings of the same object; nothing if there are none."""
    moved = numbers.moved
    if moved is None:
        return []
    runs, shown = moved.everything.runs, columns(moved.usable)
    note = "All frames after the first: mean over targets, then over sources (in brackets weighted by frames). "
    note += "A run is one source and seed. Sources may share targets."
    caption = "Transfer: each twin on other recordings of the same object, errors in mm"
    lines = average_rows(moved, moved.usable, runs, runs, shown)
    table = flat(caption, ["Method"], shown, lines, "Runs", note=note, sortable=True)
    return [table, *ratio_table(f"Transfer: ratio to {moved.name(moved.baseline)}", moved)]


def breakdown_blocks(finished: pd.DataFrame) -> list[Block]:
    """Per category and per scenario, of all finished runs."""
    shown = columns(finished)
    blocks: list[Block] = []
    for column, counted in (("category", "Scenarios"), ("scenario", "Seeds")) if shown else ():
        count, scenarios = finished[column].nunique(), finished["scenario"].nunique()
        if count == 1 or (column == "category" and count == scenarios):
            continue  # the same as the averages, or as the other breakdown
        lines: list[list[Cell]] = []
        for name, part in finished.groupby(column, sort=False):
            each = part.groupby(["method", "task", "metric", "scenario"], sort=False)["value"].mean()
            means = each.groupby(level=["method", "task", "metric"], sort=False).mean().reset_index()
            tops = best(means[["task", "metric", "value"]].itertuples(index=False))
            counts = part.groupby("method")[counted.lower().removesuffix("s")].nunique()

            def show(row: Any, metric: Metric, tops: Mapping[Any, float] = tops) -> Cell:
                top = row.value == tops.get((row.task, row.metric))
                return Cell(text=metric.text(row.value), value=row.value, mark="best" if top else "")

            made = rows(means, shown, ["method"], lambda row: [([Cell(text=row.method)], show)])
            lines += [[Cell(text=str(name)), *line, Cell(text=str(counts[line[0].text]))] for line in made]
        caption = f"Per {column} (errors in mm, seeds averaged)"
        table = flat(caption, [column.capitalize(), "Method"], shown, lines, counted, sortable=True, note="All finished runs.")
        blocks.append(Fold(summary=f"Per {column}", blocks=[table], open=column == "scenario" and len(lines) <= MOST_OPEN_ROWS))
    return blocks


def _notes(noted: pd.DataFrame, runs: pd.Series) -> list[str]:
    """Notes one by one; where they are many, how many of a method's `runs` have each kind, numbers as least to largest."""
    if len(noted) <= LISTED:
        return [f"{row.scenario} / {row.method} / seed {row.seed}: {row.notes}" for row in noted.itertuples()]
    single = noted.assign(note=noted["notes"].str.split("; ")).explode("note")
    single["kind"] = single["note"].str.replace(NUMBER, HOLE, regex=True)
    lines = []
    for key, group in single.groupby(["method", "kind"], sort=False):
        method, kind = map(str, key)
        numbers = group["note"].str.findall(NUMBER).map(lambda found: [float(number) for number in found])
        for values in zip(*numbers, strict=True):
            least, most = min(values), max(values)
            kind = kind.replace(HOLE, f"{least:g}" if least == most else f"{least:g} to {most:g}", 1)
        lines.append(f"{method}, {len(group)} of {runs[method]} runs: {kind}")
    return [*lines, "runs.csv has the notes of every run."]


def _weighted(scores: pd.DataFrame) -> bool:
    """True where scenarios have different numbers of frames, so that both averages differ."""
    return len(scores) > 0 and bool((scores.groupby(["task", "metric"])["frames"].nunique() > 1).any())


def _several_seeds(scores: pd.DataFrame) -> bool:
    """True where there is a spread over seeds to show."""
    return len(scores) > 0 and scores["seed"].nunique() > 1


def not_counted(runs: pd.DataFrame, before: Sequence[str] = (), behind: Sequence[str] = ()) -> list[Block]:
    """The runs that averages leave out, failures one by one and others by their reason; other lines stand before and behind.

    `runs` have the columns label, scenario, seed, status, counted and why (`scores.study.accounted`).
    """
    lines = list(before)
    for (label, status, why), part in runs[~runs["counted"].astype(bool)].groupby(["label", "status", "why"], sort=False):
        names = [f"{row.scenario} / seed {row.seed}" for row in part.itertuples()]
        shown = names if status == "failed" else names[:MOST_NAMED]
        more = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
        lines.append(f"{label}, {', '.join(shown)}{more}: {' '.join(str(why).split())}")
    lines += behind
    return [Items(title="Not in the averages", items=lines)] if lines else []


def timing_table(runs: pd.DataFrame) -> Table:
    """Median wall time [s] and peak memory [MB] of each stage per method."""
    stages = [name.removeprefix("seconds_") for name in runs.columns if name.startswith("seconds_")]
    lines = []
    for method, part in runs.groupby("method", sort=False):
        texts = [str(method)]
        for stage in stages:
            seconds = part[f"seconds_{stage}"].median()
            memory = part[f"memory_mb_{stage}"].median() if f"memory_mb_{stage}" in part else np.nan
            text = DASH if pd.isna(seconds) else f"{seconds:.1f} s"
            texts.append(text if pd.isna(memory) else f"{text}, {memory:.0f} MB")
        lines.append(texts)
    return Table.of_texts(["Method", *stages], lines, "Time and memory (medians)")


def figures(numbers: Numbers) -> Iterator[tuple[str, str, Figure]]:
    """File, caption and figure of the pictures that can be drawn: ratios with their intervals, and the number of regions.

    For the latter only pairs of scenario and seed count that every method clusters_<K> finished. A method that finished no run is
    left out.
    """
    usable = numbers.usable
    size = f"{usable['scenario'].nunique()} scenarios, {usable['seed'].nunique()} seed(s)" if len(usable) else ""
    # Figures have no marks around a row's name.
    if figure := ratios_figure(_named(numbers.ratios, numbers).replace("`", "", regex=True), size):
        yield "ratios.png", f"Ratio of every method's errors to those of {numbers.name(numbers.baseline)}", figure
    collected = numbers.everything
    runs = collected.runs[collected.runs["method"].isin(list(cluster_methods(collected.runs["method"])))]
    finished = list(cluster_methods(runs.loc[runs["status"] == "ok", "method"]))
    scores = collected.scores[collected.scores["method"].isin(finished)]
    usable = comparable(Collected(scores, runs[runs["method"].isin(finished)]))
    kept, asked = pairs(usable), pairs(runs)
    note = f"; {kept} of {asked} pairs of scenario\nand seed, those that every K finished" if kept < asked else ""
    if figure := clusters_figure(usable, note):
        yield "clusters.png", "Chamfer distance against the number of regions K", figure


def write(numbers: Numbers, folder: Path) -> str:
    """Write the numbers of a benchmark and its tables, and return the scores in Markdown.

    Files: numbers.json (`scores.numbers`), scores.csv, runs.csv, transfers.csv, summary.md. Where a method can be compared on
    several scenarios, also ratios.png, and with methods clusters_<K>, clusters.png; summary.md shows them.
    """
    collected, transfers = numbers.everything, numbers.transfers
    # All files are written every time, empty ones too, so that none is left over from an earlier run.
    moved = transfers.scores if transfers else pd.DataFrame(columns=list(SCORE_COLUMNS))
    for name, table in {"scores": collected.scores, "runs": collected.runs, "transfers": moved}.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
    numbers.save(folder)
    summary = summary_text(numbers)
    for name in ("ratios.png", "clusters.png"):
        (folder / name).unlink(missing_ok=True)
    shown = [f"![{caption}]({save(figure, folder / name).name})\n" for name, caption, figure in figures(numbers)]
    parts = ["# Scores\n", summary, *shown, markdown([timing_table(_named(collected.runs, numbers))])]
    write_text(folder / "summary.md", "\n".join(part for part in parts if part))
    return summary


def summary_text(numbers: Numbers) -> str:
    """The verdict, the scores, and the runs that are not among them, in Markdown."""
    blocks: Sequence[Block] = [*verdict(numbers), *score_blocks(numbers), *detail_blocks(numbers)]
    runs = numbers.everything.runs
    why = runs["status"] + ": " + runs["reason"].astype(str)
    ended = runs.assign(label=runs["method"].map(numbers.name), counted=runs["status"] == "ok", why=why)
    return markdown([*blocks, *not_counted(ended)])
