"""A benchmark's tables: averages, ratios and aims, paired differences, failures, pictures, transfers, breakdowns.

Numbers are computed once (`Benchmark`), and become tables and sentences once (`score_blocks` and the functions below it).
`summary.md` and `report.html` show the same.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuspring.config.settings import Aim
from neuspring.core.files import write_atomically, write_text
from neuspring.core.findings import Finding
from neuspring.core.table import Cell, Chip, Table
from neuspring.report.blocks import Block, Fold, Items, Text, markdown
from neuspring.report.draw.benchmark import cluster_methods, clusters_figure, ratios_figure
from neuspring.report.draw.sheet import save
from neuspring.report.notes import differing_table, honest_notes
from neuspring.report.study_cells import LEAST_SCENARIOS, ORACLE_LINE
from neuspring.report.verdict import NOUNS, verdict
from neuspring.scores import failures
from neuspring.scores import statistics as ratios
from neuspring.scores.metrics import (
    COLUMNS,
    DASH,
    DISTANCES,
    HEADINGS,
    IMAGE_HEADINGS,
    MARKED_HEADINGS,
    METRICS,
    SHORT,
    TRANSFER_HEADINGS,
    Headings,
    averages,
    headings_of,
    present,
    published,
)
from neuspring.scores.runs import Collected, comparable, finished_scores, mixed_settings, pairs
from neuspring.scores.statistics import paired_differences

NOT_COMPUTED = "not computed"
MOST_OPEN = 12
"""Most rows of a breakdown that is not folded."""
LISTED = 12
"""At most so many missing runs, or notes, are listed one by one. If there are more, they are counted by method."""
NUMBER = r"(?<![\w.])\d+(?:\.\d+)?(?!\w)"
"""A number of a note: notes that differ in numbers alone are of one kind."""
HOLE = "\ufffc"
"""Stands for a number in a kind of note."""
RATIO_CHIPS = {
    ratios.BELOW: Chip(text=ratios.BELOW, tone="good", symbol="▲"),
    ratios.ABOVE: Chip(text=ratios.ABOVE, tone="bad", symbol="▼"),
    ratios.NOT_RESOLVED: Chip(text=ratios.NOT_RESOLVED, symbol="~"),
    ratios.TOO_FEW: Chip(text=ratios.TOO_FEW, symbol="~"),
}
EMPTY = Cell(text=DASH, value="")


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """The numbers of a benchmark; each is computed when it is first asked for, the bootstrap takes seconds."""

    everything: Collected
    baseline: str
    objects: ratios.Objects = "scenario"
    """What intervals of ratios are over."""
    aims: tuple[Aim, ...] = ()
    """Ratios that are aimed at."""
    transfers: Collected | None = None
    """Twins on other recordings of the same object, as runs."""
    warnings: tuple[tuple[str, Finding], ...] = ()
    """Scenarios, and what steps of perception warned of."""
    made_otherwise: tuple[str, ...] = ()
    """Lines on runs that were not made with the configuration that the tables are laid out for."""

    @cached_property
    def collected(self) -> Collected:
        """The runs without oracles."""
        return self.everything.comparison

    @cached_property
    def usable(self) -> pd.DataFrame:
        """The scores that can be compared."""
        return comparable(self.collected)

    @cached_property
    def differences(self) -> pd.DataFrame:
        """Paired differences of every method to the baseline."""
        return paired_differences(self.usable, self.baseline) if len(self.usable) else pd.DataFrame()

    @cached_property
    def finished(self) -> pd.DataFrame:
        """Scores of all finished runs without oracles."""
        return finished_scores(self.collected)

    @cached_property
    def moved(self) -> pd.DataFrame:
        """Scores of transferred twins that finished, without oracles."""
        if self.transfers is None or not len(self.transfers.runs):
            return self.everything.scores[:0]
        oracles = self.everything.oracles
        return finished_scores(self.transfers.of([m for m in dict.fromkeys(self.transfers.runs["method"]) if m not in oracles]))

    @cached_property
    def ratios(self) -> pd.DataFrame:
        """Ratios of errors to the baseline's, over objects."""
        return ratios.ratios(self.finished, self.baseline, self.objects)

    @cached_property
    def moved_ratios(self) -> pd.DataFrame:
        """The same of transferred twins."""
        return ratios.ratios(self.moved, self.baseline, self.objects)

    @cached_property
    def judged(self) -> pd.DataFrame:
        """Aims and whether they are reached."""
        return ratios.judged_aims(self.finished, self.moved, self.aims, self.objects)

    @cached_property
    def seeds(self) -> pd.DataFrame:
        """The spread of the log error over seeds."""
        return ratios.seed_spread(self.finished)

    @cached_property
    def means(self) -> pd.DataFrame:
        """Averages without and with failed runs."""
        return failures.both_averages(*self.collected.parts)

    @property
    def size(self) -> str:
        """How much is compared, in words."""
        return f"{self.usable['scenario'].nunique()} scenarios, {self.usable['seed'].nunique()} seed(s)"


def score_blocks(benchmark: Benchmark) -> list[Block]:
    """Averages of all methods, aims, per scenario and category, pictures, marked points."""
    usable, runs = benchmark.usable, benchmark.collected.runs
    blocks: list[Block] = []
    if warning := mixed_settings(runs):
        blocks.append(Text(text=warning, tone="warn"))
    if benchmark.made_otherwise:
        about = "Runs that were made with something else than this configuration; without `only` the workflow makes them again"
        blocks.append(Items(title=about, items=[line.strip() for line in benchmark.made_otherwise]))
    if removed := failures.removed_lines(runs, benchmark.collected.left_out):
        blocks.append(Text(text=" ".join([_kept(benchmark), *removed])))
    if not len(usable) and not (runs["status"] == "ok").any():
        blocks.append(Text(text="No run has finished, so there is nothing to average.", tone="mute"))
    blocks += [errors_table(benchmark), *aim_table(benchmark.judged)]
    blocks += [*breakdown_blocks(benchmark), *image_blocks(benchmark), *marked_blocks(usable, runs), *transfer_blocks(benchmark)]
    return blocks


def detail_blocks(benchmark: Benchmark) -> list[Block]:
    """How sure the averages are: floors, spread, ratios, paired differences, failures, and what to be careful with."""
    usable, runs = benchmark.usable, benchmark.collected.runs
    headings = published(HEADINGS, usable)
    blocks: list[Block] = [Text(text=line) for line in floor_lines(runs)]
    if len(benchmark.seeds):
        about = "Standard deviation of the log error, in per cent, mean over scenarios."
        cells = published(HEADINGS, benchmark.seeds)
        blocks.append(by_method("Spread over seeds", benchmark.seeds, cells, lambda r: Cell(text=f"{100 * r.spread:.1f} %"), about))
    if len(benchmark.ratios):
        blocks.append(ratio_table(f"Ratio of the error to that of {benchmark.baseline}", benchmark, benchmark.ratios, HEADINGS))
    if len(benchmark.differences):
        blocks.append(_differences(f"Paired difference to {benchmark.baseline}, mm", benchmark.differences, headings))
        own = benchmark.differences[benchmark.differences["metric"].isin([metric for _, metric in IMAGE_HEADINGS])]
        if len(own):
            shown = {key: text for key, text in IMAGE_HEADINGS.items() if key in present(own)}
            blocks.append(_differences(f"Pictures: paired difference to {benchmark.baseline}", own, shown))
    blocks += failure_blocks(benchmark.means)
    everyone = benchmark.everything.runs
    blocks += differing_table(benchmark.everything.records.values(), {name: name for name in dict.fromkeys(everyone["method"])})
    blocks += [Text(text=line) for line in failures.left_out_lines(benchmark.collected.left_out)]
    if honest := honest_notes(benchmark.everything):
        blocks.append(Items(title="Of your own recordings", items=honest))
    noted = everyone[everyone["notes"] != ""]
    if len(noted):
        blocks.append(Items(title="Notes", items=_notes(noted, everyone["method"].value_counts())))
    return blocks


def errors_table(benchmark: Benchmark) -> Table:
    """Mean errors of every method; oracles stand below a line of their own, on the pairs that count."""
    usable, runs = benchmark.usable, benchmark.collected.runs
    headings = published(HEADINGS, usable)
    scenarios, seeds = runs["scenario"].nunique(), runs["seed"].nunique()
    size = f"{scenarios} scenario{'s' * (scenarios > 1)}, {seeds} seed{'s' * (seeds > 1)}"
    shown = {metric for _, metric in headings}
    explained = "; ".join(f"{metric.heading}: {metric.explained or metric.title}" for metric in DISTANCES if metric.name in shown)
    spread = ", ± standard deviation over seeds" if _several_seeds(usable) else ""
    weighted = "; in brackets the frame-weighted mean" if _weighted(usable) else ""
    note = f"In mm, lower is better ({size}; {explained}). Mean over scenarios{spread}{weighted}. Best in bold."
    rows = _method_rows(usable, runs, runs, headings)
    oracles = benchmark.everything.of(benchmark.everything.oracles)
    if len(oracles.runs):
        keys = ["scenario", "seed"]
        own = finished_scores(oracles)
        own = own.merge(usable[keys].drop_duplicates(), on=keys) if len(usable) else own
        rows.append([Cell(text=ORACLE_LINE), *[Cell()] * (len(headings) + 1)])
        rows += _method_rows(own, oracles.runs, oracles.runs, headings, marked=False)
    return Table(caption="Errors, mm", header=["Method", *headings.values(), "Runs"], rows=rows, note=note, sortable=True)


def _method_rows(
    scores: pd.DataFrame,
    runs: pd.DataFrame,
    counted: pd.DataFrame,
    headings: Headings,
    absent: Cell = EMPTY,
    *,
    marked: bool = True,
) -> list[list[Cell]]:
    """Both averages of every method of `runs`, and how many of its runs in `counted` finished; `absent` stands for no value."""
    several, weighted = _several_seeds(scores), _weighted(scores)
    table: list[Any] = list(averages(scores).itertuples()) if len(scores) else []
    means = {(row.method, row.task, row.metric): row for row in table}
    best = _best((row.task, row.metric, row.equal) for row in table) if marked else {}

    def cell(row: Any) -> Cell:
        metric = METRICS[row.metric]
        spread = f" ± {metric.text(row.seed_std) if np.isfinite(row.seed_std) else DASH}" if several else ""
        top = row.equal == best.get((row.task, row.metric))
        frames = [f"({metric.text(row.frames)})"] if weighted else []
        return Cell(text=metric.text(row.equal) + spread, small=frames, value=row.equal, mark="best" if top else "")

    rows = []
    for method in dict.fromkeys(runs["method"]):
        cells = [cell(means[method, *key]) if (method, *key) in means else absent for key in headings]
        status = counted.loc[counted["method"] == method, "status"].value_counts().to_dict()
        failed = f" ({status['failed']} failed)" if status.get("failed") else ""
        text = f"{status.get('ok', 0)}/{sum(status.values())}{failed}"
        rows.append([Cell(text=str(method)), *cells, Cell(text=text, tone="bad" if failed else "", value=status.get("ok", 0))])
    return rows


def _best(means: Iterable[tuple[str, str, float]]) -> dict[tuple[str, str], float]:
    """Task and metric to the best of the means (task, metric, value), where there are at least two."""
    columns: dict[tuple[str, str], list[float]] = {}
    for task, metric, value in means:
        columns.setdefault((task, metric), []).append(value)
    choose = {name: max if metric.higher_is_better else min for name, metric in METRICS.items()}
    return {key: choose[key[1]](values) for key, values in columns.items() if len(values) > 1}


def by_method(caption: str, table: pd.DataFrame, headings: Headings, cell: Callable[[Any], Cell], note: str = "") -> Table:
    """A line per method: `cell` of each task and metric in `headings`, a dash where it has no row."""
    rows = []
    for method, part in table.groupby("method", sort=False):
        values = {(row.task, row.metric): row for row in part.itertuples()}
        rows.append([Cell(text=str(method)), *(cell(values[key]) if key in values else EMPTY for key in headings)])
    return Table(caption=caption, header=["Method", *headings.values()], rows=rows, sortable=True, note=note)


def ratio_table(caption: str, benchmark: Benchmark, table: pd.DataFrame, headings: Headings) -> Table:
    """Ratios with intervals over objects and verdicts."""

    def cell(row: Any) -> Cell:
        interval = [f"[{row.ratio_low:.3f}, {row.ratio_high:.3f}]"] if np.isfinite(row.ratio_low) else []
        small = [*interval, f"(n = {row.n})"]
        return Cell(text=f"{row.ratio:.3f}", small=small, chips=[RATIO_CHIPS[row.verdict]], value=float(row.ratio))

    what = NOUNS[benchmark.objects]
    note = (
        f"Geometric mean over objects of the paired log ratio to {benchmark.baseline}, seeds averaged within an object; 95 % "
        f"t-interval over objects ({what}), none below {ratios.LEAST_OBJECTS}; n objects. Every row takes all pairs of scenario "
        "and seed that both methods finished."
    )
    return by_method(caption, table, published(headings, table), cell, note)


def aim_table(aims: pd.DataFrame) -> list[Table]:
    """A line per aim: what was aimed at, what was measured, reached or missed. Nothing without aims."""
    tones = {ratios.REACHED: "good", ratios.MISSED: "bad"}
    rows = []
    for row in cast("Any", aims.itertuples()):
        what = f"{SHORT.get(str(row.task), 'Transfer')} {METRICS[str(row.metric)].heading}"
        wanted = f"<= {row.aim:.2f}, interval below {row.below:g}"
        ratio = f"{row.ratio:.3f}" if np.isfinite(row.ratio) else DASH
        ratio += f" [{row.ratio_low:.3f}, {row.ratio_high:.3f}]" if np.isfinite(row.ratio_low) else ""
        texts = [str(row.method), str(row.baseline), what, wanted, ratio, str(row.n)]
        verdict = Chip(text=str(row.aim_verdict), tone=tones.get(str(row.aim_verdict), "mute"))  # type: ignore[arg-type]
        rows.append([*(Cell(text=text) for text in texts), Cell(chips=[verdict])])
    header = ["Method", "Against", "What", "Aim", "Ratio [95 % interval]", "n", "Verdict"]
    return [Table(caption="Aims, declared in the configuration", header=header, rows=rows)] if rows else []


def _differences(caption: str, differences: pd.DataFrame, headings: Headings) -> Table:
    def cell(row: Any) -> Cell:
        metric = METRICS[row.metric]
        interval = [f"[{metric.text(row.low, '+')}, {metric.text(row.high, '+')}]"] if np.isfinite(row.low) else []
        relative = [] if metric.of_pictures else [f"({100 * row.relative:+.1f} %)"]
        chips = [_resolved(row, metric.higher_is_better)] if interval else []
        return Cell(text=metric.text(row.difference, "+"), small=interval + relative, chips=chips, value=float(row.difference))

    note = "Same scenario and seed; 95 % bootstrap interval over scenarios and seeds, none for a single scenario."
    return by_method(caption, differences, headings, cell, note)


def _resolved(row: Any, higher: bool) -> Chip:
    if row.scenarios < LEAST_SCENARIOS:
        return Chip(text="too few scenarios", symbol="~")
    if row.low <= 0 <= row.high:
        return Chip(text="not resolved", symbol="~")
    return Chip(text="better", tone="good", symbol="▲") if (row.low > 0) == higher else Chip(text="worse", tone="bad", symbol="▼")


def failure_blocks(means: pd.DataFrame) -> list[Block]:
    """Both averages of every method, where some run failed (`failures.both_averages`)."""
    if not len(means):
        return []

    def cell(row: Any, column: str) -> Cell:
        metric = METRICS[row["metric"]]
        if not np.isfinite(row[column]):
            return EMPTY
        return Cell(text=metric.text(row[column]), small=[f"({metric.text(row[f'{column}_frames'])})"])

    methods = dict.fromkeys(means["method"])
    headings = headings_of(means)
    table = failure_table("Failures (errors in mm)", means, {name: name for name in methods}, list(headings), cell)
    note = f"{failures.WHY} In brackets the frame-weighted mean. {failures.DASHES}"
    header = [*table.header, *headings.values()]
    made = Table(caption=table.caption, header=header, rows=table.rows, stub=3, note=note)
    return [made, *(Text(text=text, tone="warn") for text in failures.unknown_lines(means))]


def failure_table(
    caption: str, means: pd.DataFrame, labels: Mapping[str, str], keys: list[tuple[str, str]], cell: Callable[[Any, str], Cell]
) -> Table:
    """For every method (with its label) its means over its successes and over all its runs; `cell` of a row and a column."""
    rows = []
    for method, label in labels.items():
        part = means[means["method"] == method]
        if not len(part):
            continue
        found = {(row["task"], row["metric"]): row for row in part.to_dict("records")}
        first = part.iloc[0]
        lost = first["succeeded"] < first["attempted"]
        stub = [Cell(text=label), Cell(text=f"{first['succeeded']}/{first['attempted']}", tone="bad" if lost else "")]
        for over, column in failures.mean_rows(part):
            rows.append([*stub, Cell(text=over), *(cell(found[key], column) if key in found else EMPTY for key in keys)])
            stub = [Cell(), Cell()]
    return Table(caption=caption, header=["Method", "Succeeded", "Mean over"], rows=rows, stub=3)


def floor_lines(runs: pd.DataFrame) -> list[str]:
    """The errors in frame 0, which is given: mean over scenarios, and the range. Nothing where records do not have them."""
    found = floors_of(runs)
    parts = []
    for metric in DISTANCES:
        values = found.loc[found["metric"] == f"{metric.name}_floor", "value"]
        if len(values) and metric.paper_name:
            spread = f" ({metric.text(values.min())} to {metric.text(values.max())})" if len(values) > 1 else ""
            parts.append(f"{metric.heading} {metric.text(values.mean())} mm{spread}")
    if not parts:
        return []
    of = f", mean of {count} scenarios (least to largest)" if (count := found["scenario"].nunique()) > 1 else ""
    text = f"Floor in frame 0{of}: {', '.join(parts)}; TE bound 0 by construction."
    return [f"{text} A floor is no motion: it is how far points are from nodes."]


def floors_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Floors per scenario: scenario, metric (chamfer_floor, ...), value [m]. Methods of a scenario begin with the same nodes."""
    rows: dict[tuple[str, str], float] = {}
    for row in runs.itertuples() if "floors" in runs else ():
        values = json.loads(row.floors) if isinstance(row.floors, str) else {}
        rows |= {(str(row.scenario), f"{name}_floor"): value for name, value in values.items()}
    return pd.DataFrame([(*key, value) for key, value in rows.items()], columns=["scenario", "metric", "value"])


def image_blocks(benchmark: Benchmark) -> list[Block]:
    """How pictures were scored, both averages and paired differences; a sentence if there are none."""
    collected, scores = benchmark.collected, benchmark.usable
    if "images" not in collected.runs:
        return [Text(text="No scores of pictures: no run has finished.")]
    runs = collected.runs.dropna(subset="images")
    runs = runs.assign(images=runs["images"].map(json.loads))
    runs = runs[[bool(facts) for facts in runs["images"]]]
    if not len(runs):
        return [Text(text="No scores of pictures: these scenarios have no images, or images.enabled is off.")]
    rendered = runs[["failed" not in facts for facts in runs["images"]]]
    pictured = scores[scores["metric"].isin([metric for _, metric in IMAGE_HEADINGS])] if len(scores) else scores
    if not len(rendered) or not len(pictured):
        reasons = sorted({str(facts["failed"]) for facts in runs["images"] if "failed" in facts})
        return [Text(text=f"No scores of pictures: {'; '.join(reasons) or 'no run that can be compared has them'}.")]
    have, asked = pictured["scenario"].nunique(), collected.runs["scenario"].nunique()
    some = "" if have == asked else f"Of {asked} scenarios {have} have scores of pictures. "
    weighted = "; in brackets the frame-weighted mean" if _weighted(pictured) else ""
    note = (
        f"Higher is better; LPIPS: lower; PSNR in dB. {some}{_image_conditions(rendered['images'])} Mean over scenarios{weighted}."
    )
    headings = {key: text for key, text in IMAGE_HEADINGS.items() if key[1] in set(pictured["metric"])}
    rows = _method_rows(pictured, collected.runs, runs, headings, Cell(text=NOT_COMPUTED, value=""))
    header = ["Method", *headings.values(), "Runs"]
    caption = "Scores of pictures"
    blocks: list[Block] = [Table(caption=caption, header=header, rows=rows, note=note, sortable=True)]
    blocks.append(Text(text=f"Part of the surface that no camera sees in frame 0: {_unseen(rendered)}."))
    where = "in some runs " if "lpips" in set(pictured["metric"]) else ""
    reasons = sorted({str(facts["lpips"]) for facts in rendered["images"]} - {"computed"})
    blocks += [Text(text=f"LPIPS {where}not computed: {reason}") for reason in reasons]
    return blocks


def _unseen(runs: pd.DataFrame) -> str:
    """Scenarios and the share of their surface that frame 0 hides, in words."""
    shares: dict[str, list[float | None]] = {}
    for scenario, facts in zip(runs["scenario"], runs["images"], strict=True):
        shares.setdefault(str(scenario), []).append(facts["unseen_surface"])
    numbers = {name: [value for value in values if value is not None] for name, values in shares.items()}
    return ", ".join(f"{name} {f'{np.mean(v):.0%}' if v else 'unknown (no shape prior)'}" for name, v in numbers.items())


def _image_conditions(facts: Iterable[dict[str, Any]]) -> str:
    """How pictures were scored, from the runs' records."""

    def several(name: str) -> str:
        return " and ".join(sorted({", ".join(v) if isinstance(v := values[name], list) else str(v) for values in facts}))

    quirks = several("quirks")
    text = f"Cameras scored: {several('views')}; masks: {several('masks')}; rasterizer: {several('backend')}"
    return f"{text}; released quirks: {quirks}." if quirks.strip() else f"{text}; none of the released evaluation's quirks."


def marked_blocks(scores: pd.DataFrame, runs: pd.DataFrame) -> list[Block]:
    """Errors of points that were marked in images; nothing where there are none."""
    headings = {key: text for key, text in MARKED_HEADINGS.items() if key in present(scores)} if len(scores) else {}
    if not headings:
        return []
    own = scores[scores["metric"].isin([metric for _, metric in headings])]
    have, asked = own["scenario"].nunique(), runs["scenario"].nunique()
    note = f"{have} of {asked} scenarios, lower is better: px in the image; mm on the table."
    rows = _method_rows(own, runs, runs[runs["scenario"].isin(own["scenario"])], headings)
    return [Table(caption="Points marked in images", header=["Method", *headings.values(), "Runs"], rows=rows, note=note)]


def transfer_blocks(benchmark: Benchmark) -> list[Block]:
    """Twins on other recordings of the same object; nothing if there are none."""
    collected, baseline = benchmark.transfers, benchmark.baseline
    if collected is None or not len(collected.runs):
        return []
    scores = comparable(collected.comparison)
    differences = paired_differences(scores, baseline) if len(scores) else pd.DataFrame()
    headings = published(TRANSFER_HEADINGS, scores)
    rows = _method_rows(scores, collected.runs, collected.runs, headings)
    note = "All frames after the first: mean over targets, then over sources (in brackets weighted by frames). "
    note += "A run is one source and seed."
    caption = "Transfer: each twin on other recordings of the same object, errors in mm"
    header = ["Method", *headings.values(), "Runs"]
    blocks: list[Block] = [Table(caption=caption, header=header, rows=rows, note=note, sortable=True)]
    if len(differences):
        blocks.append(_differences(f"Transfer: paired difference to {baseline}, mm", differences, headings))
        blocks.append(Text(text="Intervals are over sources and seeds; sources may share targets."))
    if len(benchmark.moved_ratios):
        blocks.append(ratio_table(f"Transfer: ratio to {baseline}", benchmark, benchmark.moved_ratios, TRANSFER_HEADINGS))
    return blocks


def breakdown_blocks(benchmark: Benchmark) -> list[Block]:
    """Per category and per scenario, of all finished runs."""
    finished = benchmark.finished
    headings = {key: text for key, text in HEADINGS.items() if key in present(finished)} if len(finished) else {}
    blocks: list[Block] = []
    for column, counted in (("category", "Scenarios"), ("scenario", "Seeds")) if headings else ():
        count, scenarios = finished[column].nunique(), finished["scenario"].nunique()
        if count == 1 or (column == "category" and count == scenarios):
            continue  # the same as the averages, or as the other breakdown
        rows = []
        for name, part in finished.groupby(column, sort=False):
            means = part.groupby(["method", "task", "metric", "scenario"])["value"].mean().groupby(level=[0, 1, 2]).mean()
            values: dict[Any, float] = {key: float(value) for key, value in means.items()}
            best = _best((task, metric, value) for (_, task, metric), value in values.items())
            counts = part.groupby("method", sort=False)[counted.lower().removesuffix("s")].nunique()
            for method, count in counts.items():
                cells = [_breakdown_cell(values.get((method, *key)), key, best.get(key)) for key in headings]
                rows.append([Cell(text=str(name)), Cell(text=str(method)), *cells, Cell(text=str(count))])
        caption, header = (
            f"Per {column} (errors in mm, seeds averaged)",
            [column.capitalize(), "Method", *headings.values(), counted],
        )
        table = Table(caption=caption, header=header, rows=rows, stub=2, sortable=True, note="All finished runs.")
        blocks.append(Fold(summary=f"Per {column}", blocks=[table], open=column == "scenario" and len(rows) <= MOST_OPEN))
    return blocks


def _breakdown_cell(value: float | None, key: tuple[str, str], best: float | None) -> Cell:
    if value is None:
        return EMPTY
    return Cell(text=METRICS[key[1]].text(value), value=value, mark="best" if value == best else "")


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


def _kept(benchmark: Benchmark) -> str:
    """How many pairs of scenario and seed the averages take."""
    usable, runs = benchmark.usable, benchmark.collected.runs
    if not len(usable):
        return "No pair of scenario and seed was finished by every method, so there is no average of all methods."
    return f"Averages take {pairs(usable)} of {pairs(runs)} pairs of scenario and seed, those that every method finished."


def _weighted(scores: pd.DataFrame) -> bool:
    """Whether scenarios have different numbers of frames, so that both averages differ."""
    return len(scores) > 0 and bool((scores.groupby(["task", "metric"])["frames"].nunique() > 1).any())


def _several_seeds(scores: pd.DataFrame) -> bool:
    """Whether there is a spread over seeds to show."""
    return len(scores) > 0 and scores["seed"].nunique() > 1


def not_counted(runs: pd.DataFrame) -> list[Block]:
    """Failures one by one; runs that are missing too, unless they are many, as when `only` makes a part of them."""
    bad = runs[runs["status"] != "ok"]
    missing = bad[bad["status"] == "missing"]
    listed = bad if len(missing) <= LISTED else bad[bad["status"] != "missing"]
    lines = [f"{row.scenario} / {row.method} / seed {row.seed}: {row.status}: {row.reason}" for row in listed.itertuples()]
    if len(missing) > LISTED:
        counts = ", ".join(f"{method} {count}" for method, count in missing["method"].value_counts(sort=False).items())
        lines.append(f"{len(missing)} runs have not finished, or were not asked for ({counts}); runs.csv names them.")
    return [Items(title="Not in the averages", items=lines)] if lines else []


def timing_table(runs: pd.DataFrame) -> Table:
    """Median wall time [s] and peak memory [MB] of each stage per method."""
    stages = [name.removeprefix("seconds_") for name in runs.columns if name.startswith("seconds_")]
    rows = []
    for method, part in runs.groupby("method", sort=False):
        cells = [Cell(text=str(method))]
        for stage in stages:
            seconds = part[f"seconds_{stage}"].dropna()
            memory = part[f"memory_mb_{stage}"].dropna() if f"memory_mb_{stage}" in part else seconds[:0]
            text = f"{seconds.median():.1f} s" if len(seconds) else DASH
            cells.append(Cell(text=text + (f", {memory.median():.0f} MB" if len(memory) else "")))
        rows.append(cells)
    return Table(caption="Time and memory (medians)", header=["Method", *stages], rows=rows)


def pictures(benchmark: Benchmark) -> Iterator[tuple[str, str, Figure]]:
    """File, caption and figure of the pictures that can be drawn: ratios with their intervals, and the number of regions.

    For the latter only pairs of scenario and seed count that every method clusters_<K> finished. A method that finished no run is
    left out.
    """
    figure = ratios_figure(benchmark.ratios, benchmark.size if len(benchmark.usable) else "")
    if figure:
        yield "ratios.png", f"Ratio of every method's errors to those of {benchmark.baseline}", figure
    collected = benchmark.everything
    runs = collected.runs[collected.runs["method"].isin(list(cluster_methods(collected.runs["method"])))]
    finished = list(cluster_methods(runs.loc[runs["status"] == "ok", "method"]))
    scores = collected.scores[collected.scores["method"].isin(finished)]
    usable = comparable(Collected(scores, runs[runs["method"].isin(finished)]))
    kept, asked = pairs(usable), pairs(runs)
    note = f"; {kept} of {asked} pairs of scenario\nand seed, those that every K finished" if kept < asked else ""
    if figure := clusters_figure(usable, note):
        yield "clusters.png", "Chamfer distance against the number of regions K", figure


def write(benchmark: Benchmark, folder: Path) -> str:
    """Write the tables of a benchmark, and return the scores in Markdown.

    Files: scores.csv, scores.parquet, runs.csv, averages.csv, differences.csv, held.csv (failures in the averages), floors.csv
    (errors in frame 0), ratios.csv, aims.csv, seeds.csv (spread over seeds), transfers.csv, summary.md. Where a method can be
    compared on several scenarios, also ratios.png, and with methods clusters_<K>, clusters.png; summary.md shows them.
    """
    collected, transfers = benchmark.everything, benchmark.transfers
    both = [table for table in (benchmark.ratios, benchmark.moved_ratios) if len(table)]
    # All files are written every time, empty ones too, so that none is left over from an earlier run.
    tables = {
        "scores": collected.scores,
        "runs": collected.runs,
        "averages": averages(benchmark.usable) if len(benchmark.usable) else pd.DataFrame(),
        "differences": benchmark.differences,
        "held": benchmark.means,
        "floors": floors_of(collected.runs),
        "ratios": pd.concat(both or [benchmark.ratios]),
        "aims": benchmark.judged,
        "seeds": benchmark.seeds,
        "transfers": transfers.scores if transfers else pd.DataFrame(columns=list(COLUMNS)),
    }
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
    write_atomically(folder / "scores.parquet", lambda temporary: collected.scores.to_parquet(temporary, index=False))
    summary = summary_text(benchmark)
    for name in ("ratios.png", "clusters.png"):
        (folder / name).unlink(missing_ok=True)
    shown = [f"![{caption}]({save(figure, folder / name).name})\n" for name, caption, figure in pictures(benchmark)]
    parts = ["# Scores\n", summary, *shown]
    parts += [markdown([timing_table(collected.runs)])]
    write_text(folder / "summary.md", "\n".join(part for part in parts if part))
    return summary


def summary_text(benchmark: Benchmark) -> str:
    """The verdict, the scores, and the runs that are not among them, in Markdown."""
    blocks = [*verdict(benchmark), *score_blocks(benchmark), *detail_blocks(benchmark)]
    return markdown([*blocks, *not_counted(benchmark.everything.runs)])
