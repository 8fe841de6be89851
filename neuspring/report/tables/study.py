"""The tables of a study beside the paper's: CSV, Markdown and LaTeX from run records.

Per study, in one folder: <study>.md and .tex (to read), .csv (a row per cell), _runs.csv (which runs count, and why not the
others), _failures.csv (averages without and with failed runs), _scenarios.csv, _categories.csv, .json (what the table was made
of, for `neuspring explain`); where the released PhysTwin's method is a row, and its scenarios are among the runs, also
_released_phystwin.csv and .md; for the number of regions _curve.png.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.config import parse
from neuspring.config.parse import STRICT, Name
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json
from neuspring.core.text import markdown
from neuspring.report.figures.clusters import cluster_methods, clusters_figure
from neuspring.report.tables.cells import LEAST_SCENARIOS, accounted, cells, counted, of_study
from neuspring.report.tables.differing import differing, differing_markdown
from neuspring.report.tables.render import (
    PREAMBLE,
    Grid,
    as_latex,
    as_markdown,
    beyond_grid,
    both_trainings,
    change_grid,
    differing_latex,
    failures_grid,
    interval_grid,
    main_grid,
    other_grid,
    values_grid,
)
from neuspring.scores import paper
from neuspring.scores.failures import NOTHING, LeftOut, both_averages, left_out_lines, removed_lines, unknown_lines
from neuspring.scores.metrics import DASH, IN_PAPER, IN_STUDIES, Metric, averages
from neuspring.scores.runs import Collected, collect, mixed_settings, pairs
from neuspring.scores.studies import Study

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


@dataclass(frozen=True, kw_only=True)
class Made:
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
    def load(cls, path: Path) -> Made:
        """Read <name>.json. Raises InputError."""
        return parse(cls, read_json(path, RECORD_FORMAT), str(path))


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
    benchmark, shown = set(known_methods), [*study.rows.values(), *(beside.rows.values() if beside else ())]
    methods = [method for method in dict.fromkeys(shown) if method in benchmark]
    return write_collected(name, study, collect(results, scenarios, methods, seeds, left_out), folder, beside)


def write_collected(name: str, study: Study, collected: Collected, folder: Path, beside: Study | None = None) -> str:
    """As `write_study`, from runs that are read already. Methods of other studies are ignored."""
    own = of_study(study, collected)
    scores, table, runs = counted(own), cells(study, own), accounted(study, own)
    scenarios, categories = by_scenario(study, own, runs), by_category(study, scores)
    means = both_averages(*own.comparison.parts)
    files = {"": table.assign(study=name), "_runs": runs, "_scenarios": scenarios, "_categories": categories, "_failures": means}
    for suffix, rows in files.items():
        write_text(folder / f"{name}{suffix}.csv", rows.to_csv(index=False))
    names = {column: tuple(dict.fromkeys(own.runs[column].tolist())) for column in ("scenario", "method", "seed")}
    absent = {method: tuple(where) for method, where in own.left_out.items()}
    methods = tuple(dict.fromkeys([*names["method"], *absent]))
    Made(name=name, study=study, scenarios=names["scenario"], methods=methods, seeds=names["seed"], left_out=absent).save(folder)
    grids = _captioned(study, own, scores, table, means)
    grids += both_trainings(study, table, beside, cells(beside, of_study(beside, collected))) if beside else []
    titles = [f"{study.title}{f': {grid.title}' if grid.title else ''}" for grid in grids]
    floats = [as_latex(grid, f"{name}-{index + 1}", titles[index]) for index, grid in enumerate(grids)]
    footnote = differing(own.records.values(), _labels(study))
    write_text(folder / f"{name}.tex", "\n".join([PREAMBLE, *floats, *differing_latex(footnote, name, study.title)]))
    warning = mixed_settings(own.runs)
    parts = [f"# {study.title}\n", f"**{warning}**\n" if warning else "", *map(as_markdown, grids)]
    parts.append(differing_markdown(footnote))
    parts.append(_curve(study, scores, folder / f"{name}_curve.png"))
    parts.append(_left_out(runs, study, name, own))
    if len(categories):
        note = "Ours, in the average that the paper takes."
        parts.append(as_markdown(values_grid("Per category", note, ("Category", "Method"), categories, ["category", "label"])))
    if len(scenarios):
        note = "Ours, all finished runs, seeds averaged."
        parts.append(as_markdown(values_grid("Per scenario", note, ("Scenario", "Method"), scenarios, ["scenario", "label"])))
    parts.append(_write_released(name, study, own, folder))
    text = "\n".join(part for part in parts if part)
    write_text(folder / f"{name}.md", text)
    return text


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
    """Every value of the released PhysTwin with ours beside it, m; NaN where there is no finished run on the released data."""
    mine = (own.runs["status"] == "ok") & (own.runs["source"] == "phystwin") & (own.runs["method"] == method)
    finished = own.runs.loc[mine, ["scenario", "method", "seed"]]
    keys = ["scenario", "task", "metric"]
    ours = own.scores.merge(finished).groupby(keys)["value"].agg(ours="mean", spread="std", seeds="count").reset_index()
    table = paper.released().rename(columns={"value": "released"}).merge(ours, on=keys, how="left")
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


def _captioned(study: Study, own: Collected, scores: pd.DataFrame, table: pd.DataFrame, means: pd.DataFrame) -> list[Grid]:
    """The grids that have lines. The note of the first one explains averages and verdicts."""
    kept = pairs(scores)
    which = f"Averages take the {kept} of {pairs(own.runs)} pairs of scenario and seed "
    which += "that every method with a finished run has finished."
    beyond = table[~table["metric"].isin(list(IN_PAPER))] if study.reference else table[:0]
    table = table.drop(beyond.index)
    main, change = main_grid(study, table), change_grid(study, table)
    labels = _labels(study)
    removed = " ".join(removed_lines(own.comparison.runs, own.left_out, labels))
    finished = (own.runs["status"] == "ok").any()
    nothing = "No pair of scenario and seed was finished by every method." if finished else "Nothing has finished."
    notes = [main.note, VERDICTS if study.reference else "", which if kept else nothing, removed, _pictures(own)]
    notes += [paper.CLUSTER_CLAIM] if cluster_methods(study.rows.values()) else []
    main = dataclasses.replace(main, note=" ".join(note for note in notes if note))
    change = dataclasses.replace(change, note=f"{change.note} {DIRECTIONS}")
    failures = failures_grid(study, means)
    unknown = unknown_lines(means, labels)
    failures = dataclasses.replace(failures, note=" ".join([failures.note, *unknown]))
    return [
        grid for grid in (main, beyond_grid(study, beyond), failures, interval_grid(table), change, other_grid(table)) if grid.lines
    ]


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


def _curve(study: Study, scores: pd.DataFrame, path: Path) -> str:
    """The section with the picture of the number of regions, in a study of that number."""
    if len(cluster_methods(study.rows.values())) < 2 or not len(scores) or clusters_figure(scores, path) is None:
        path.unlink(missing_ok=True)
        return ""
    return f"![Chamfer distance against the number of regions K]({path.name})\n"


def _left_out(runs: pd.DataFrame, study: Study, name: str, own: Collected) -> str:
    """The runs that averages leave out, failures one by one and others by their reason, and the rows without a method."""
    asked = set(runs["label"]) | {label for label, method in study.rows.items() if method in own.left_out}
    lines = [
        f"- {label}: {method} is not among the methods of this benchmark"
        for label, method in study.rows.items()
        if label not in asked
    ]
    left = runs[~runs["counted"].astype(bool)]
    for (label, status, why), part in left.groupby(["label", "status", "why"], sort=False):
        names = [f"{row.scenario} / seed {row.seed}" for row in part.itertuples()]
        shown = names if status == "failed" else names[:NAMED]
        more = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
        lines.append(f"- {label}, {', '.join(shown)}{more}: {' '.join(str(why).split())}")
    lines += [f"- {text}" for text in left_out_lines(own.left_out, _labels(study))]
    if not lines:
        return ""
    return "\n".join(["## Not in the averages\n", f"Every run: {name}_runs.csv.\n", *lines]) + "\n"


def _write_released(name: str, study: Study, own: Collected, folder: Path) -> str:
    """The comparison with the released PhysTwin, if its method is a row; returns the section that names it."""
    method = next((method for method in RELEASED_METHODS if method in study.rows.values()), None)
    if method is None or not own.runs["scenario"].isin(paper.scenarios()).any():
        return ""
    table, stem = released_comparison(own, method), f"{name}_released_phystwin"
    write_text(folder / f"{stem}.csv", table.to_csv(index=False))
    head = f"# Ours ({method}) beside the released PhysTwin, per scenario\n"
    note = "m; mean over seeds (± standard deviation). The released values of the training frames are known for 11 scenarios.\n"
    rows = []
    for (task, metric), part in table.groupby(["task", "metric"], sort=True):
        both = part.dropna(subset="ours")
        of_paper = IN_STUDIES[str(metric)]
        lines = [[str(row.scenario), *_released_cells(row, of_paper)] for row in part.itertuples()]
        if len(both):
            mean = both[["released", "ours", "difference"]].mean()
            mean["ratio"], mean["spread"] = mean["ours"] / mean["released"], np.nan
            lines.append([f"mean of {len(both)}", *_released_cells(mean, of_paper)])
        heading = f"## {str(task).capitalize()}, {of_paper.paper_heading}\n"
        rows += [heading, "\n".join(markdown(["Scenario", "Released", "Ours", "Difference", "Ratio"], lines)) + "\n"]
    write_text(folder / f"{stem}.md", "\n".join([head, note, *rows]))
    count = int(table.loc[table["ours"].notna(), "scenario"].nunique())
    where = f"{count} of {len(paper.scenarios())} scenarios have finished" if count else "nothing has finished on its scenarios"
    return f"## Beside the released PhysTwin\n\n[Per scenario]({stem}.md): {where}.\n"


def _released_cells(row: Any, metric: Metric) -> list[str]:
    around = f" ± {metric.paper_text(row.spread)}" if np.isfinite(row.spread) else ""
    ratio = f"{row.ratio:.3f}" if np.isfinite(row.ratio) else DASH
    return [
        metric.paper_text(row.released),
        metric.paper_text(row.ours) + around,
        metric.paper_text(row.difference, "+"),
        ratio,
    ]
