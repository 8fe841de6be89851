"""The summary of a benchmark in Markdown and CSV: every score, averages per method, paired comparisons, and what failed."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.files import write_atomically, write_text
from neuspring.core.text import markdown
from neuspring.report.figures.clusters import NAME as CLUSTERS
from neuspring.report.figures.clusters import cluster_methods, clusters_figure
from neuspring.report.figures.ratios import NAME as RATIOS
from neuspring.report.figures.ratios import ratios_figure
from neuspring.report.tables.cells import ORACLE_LINE
from neuspring.report.tables.differing import differing, differing_markdown
from neuspring.report.tables.honest import honest_notes
from neuspring.report.tables.ratios import Judged, Judging, by_method, judged, ratio_lines, transfer_lines
from neuspring.scores.failures import both_averages, failures_text, left_out_lines, removed_lines
from neuspring.scores.metrics import (
    COLUMNS,
    DASH,
    DISTANCES,
    HEADINGS,
    IMAGE_HEADINGS,
    MARKED_HEADINGS,
    METRICS,
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
LISTED = 12
"""At most so many missing runs, or notes, are listed one by one. If there are more, they are counted by method."""
NUMBER = r"(?<![\w.])\d+(?:\.\d+)?(?!\w)"
"""A number of a note: notes that differ in numbers alone are of one kind."""
HOLE = "\ufffc"
"""Stands for a number in a kind of note."""


def compared(collected: Collected, baseline: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The scores that can be compared, and the paired differences of every method to `baseline`."""
    scores = comparable(collected.comparison)
    return scores, paired_differences(scores, baseline) if len(scores) else pd.DataFrame()


def summary_text(
    collected: Collected, baseline: str, differences: pd.DataFrame | None = None, figures: Judged | None = None
) -> str:
    """The tables in Markdown, in millimeters: both averages, ratios and aims, the paired comparison, failures.

    `differences` and `figures` are the paired ones if the caller has them; the bootstrap takes seconds on a large benchmark.
    """
    figures = figures or judged(collected, baseline, Judging())
    everything, collected = collected, collected.comparison
    if differences is None:
        scores, differences = compared(collected, baseline)
    else:
        scores = comparable(collected)
    runs, several = collected.runs, _several_seeds(scores)
    scenarios, seeds = runs["scenario"].nunique(), runs["seed"].nunique()
    size = f"{scenarios} scenario{'s' * (scenarios > 1)}, {seeds} seed{'s' * (seeds > 1)}"
    spread = ", ± standard deviation over seeds" if several else ""
    shown = {metric for _, metric in published(HEADINGS, scores)}
    explained = "; ".join(f"{metric.heading}: {metric.explained or metric.title}" for metric in DISTANCES if metric.name in shown)
    lines = [f"Errors in mm, lower is better ({size}; {explained}).", ""]
    lines += [f"Mean over scenarios{spread}; in brackets the frame-weighted mean.", ""]
    if removed := removed_lines(runs, collected.left_out):
        lines += [" ".join([_kept_line(scores, runs), *removed]), ""]
    if warning := mixed_settings(runs):
        lines += [f"**{warning}**", ""]
    headings = published(HEADINGS, scores)
    lines += [*_method_table(scores, runs, runs, headings), *_oracle_rows(everything, scores, headings)]
    lines += [*floor_lines(runs), *ratio_lines(figures)]
    if len(differences):
        intro = f"Paired difference to {baseline}, mm [95 % bootstrap interval over scenarios and seeds], same scenario and seed:"
        lines += ["", intro, "", *by_method(differences, headings, _interval)]
    lines += image_lines(collected, scores, differences, baseline)
    lines += marked_lines(scores, runs)
    runs = everything.runs
    footnote = differing_markdown(differing(everything.records.values(), {name: name for name in dict.fromkeys(runs["method"])}))
    lines += ["", footnote] if footnote else []
    bad = runs[runs["status"] != "ok"]
    if len(bad):
        lines += ["", "Not in the averages:", "", *_not_counted(bad)]
    lines += [line for text in left_out_lines(collected.left_out) for line in ("", text)]
    if honest := honest_notes(everything):
        lines += ["", "Of your own recordings:", "", *(f"- {note}" for note in honest)]
    noted = runs[runs["notes"] != ""]
    if len(noted):
        lines += ["", "Notes:", ""]
        lines += _note_lines(noted, runs["method"].value_counts())
    return "\n".join(lines) + "\n"


def _note_lines(noted: pd.DataFrame, runs: pd.Series) -> list[str]:
    """Notes one by one; where they are many, how many of a method's `runs` have each kind, numbers as least to largest."""
    if len(noted) <= LISTED:
        return [f"- {row.scenario} / {row.method} / seed {row.seed}: {row.notes}" for row in noted.itertuples()]
    single = noted.assign(note=noted["notes"].str.split("; ")).explode("note")
    single["kind"] = single["note"].str.replace(NUMBER, HOLE, regex=True)
    lines = []
    for key, group in single.groupby(["method", "kind"], sort=False):
        method, kind = map(str, key)
        numbers = group["note"].str.findall(NUMBER).map(lambda found: [float(number) for number in found])
        for least, most in _ranges(numbers):
            kind = kind.replace(HOLE, f"{least:g}" if least == most else f"{least:g} to {most:g}", 1)
        lines.append(f"- {method}, {len(group)} of {runs[method]} runs: {kind}")
    return [*lines, "- runs.csv has the notes of every run."]


def _ranges(numbers: pd.Series) -> list[tuple[float, float]]:
    """Least and largest of each place in lists of equal length."""
    return [(min(place), max(place)) for place in zip(*numbers, strict=True)]


def _kept_line(scores: pd.DataFrame, runs: pd.DataFrame) -> str:
    """How many pairs of scenario and seed the averages take."""
    if not len(scores):
        return "No pair of scenario and seed was finished by every method, so there is no average of all methods."
    return f"Averages take {pairs(scores)} of {pairs(runs)} pairs of scenario and seed, those that every method finished."


def _several_seeds(scores: pd.DataFrame) -> bool:
    """Whether there is a spread over seeds to show."""
    return len(scores) > 0 and scores["seed"].nunique() > 1


def _not_counted(bad: pd.DataFrame) -> list[str]:
    """Failures one by one; runs that are missing too, unless they are many, as when `only` makes a part of them."""
    missing = bad[bad["status"] == "missing"]
    listed = bad if len(missing) <= LISTED else bad[bad["status"] != "missing"]
    lines = [f"- {row.scenario} / {row.method} / seed {row.seed}: {row.status}: {row.reason}" for row in listed.itertuples()]
    if len(missing) > LISTED:
        counts = ", ".join(f"{method} {count}" for method, count in missing["method"].value_counts(sort=False).items())
        lines.append(f"- {len(missing)} runs have not finished, or were not asked for ({counts}); runs.csv names them.")
    return lines


def _method_table(
    scores: pd.DataFrame, runs: pd.DataFrame, counted: pd.DataFrame, headings: Headings, absent: str = DASH
) -> list[str]:
    """Both averages of every method of `runs`, and how many of its runs in `counted` finished; `absent` stands for no value."""
    several = _several_seeds(scores)
    table: list[Any] = list(averages(scores).itertuples()) if len(scores) else []
    means = {(row.method, row.task, row.metric): row for row in table}
    rows = []
    for method in dict.fromkeys(runs["method"]):
        cells = [_mean(means.get((method, *key)), several, absent) for key in headings]
        status = counted.loc[counted["method"] == method, "status"].value_counts().to_dict()
        failed = f" ({status['failed']} failed)" if status.get("failed") else ""
        rows.append([method, *cells, f"{status.get('ok', 0)}/{sum(status.values())}{failed}"])
    return markdown(["Method", *headings.values(), "Runs"], rows)


def _oracle_rows(collected: Collected, scores: pd.DataFrame, headings: Headings) -> list[str]:
    """A line that says what oracles are, then theirs, to be added to the table of methods; on the pairs of `scores`."""
    oracles = collected.of(collected.oracles)
    if not len(oracles.runs):
        return []
    keys = ["scenario", "seed"]
    own = finished_scores(oracles)
    own = own.merge(scores[keys].drop_duplicates(), on=keys) if len(scores) else own
    _, _, *rows = _method_table(own, oracles.runs, oracles.runs, headings)
    return [f"| *{ORACLE_LINE}* |{' |' * (len(headings) + 1)}", *rows]


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
    return ["", f"{text} A floor is no motion: it is how far points are from nodes."]


def floors_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Floors per scenario: scenario, metric (chamfer_floor, ...), value [m]. Methods of a scenario begin with the same nodes."""
    rows: dict[tuple[str, str], float] = {}
    for row in runs.itertuples() if "floors" in runs else ():
        values = json.loads(row.floors) if isinstance(row.floors, str) else {}
        rows |= {(str(row.scenario), f"{name}_floor"): value for name, value in values.items()}
    return pd.DataFrame([(*key, value) for key, value in rows.items()], columns=["scenario", "metric", "value"])


def _mean(row: Any, several: bool, absent: str) -> str:
    if row is None:
        return absent
    metric = METRICS[row.metric]
    spread = f" ± {metric.text(row.seed_std) if np.isfinite(row.seed_std) else DASH}" if several else ""
    return f"{metric.text(row.equal)}{spread} ({metric.text(row.frames)})"


def _interval(row: Any) -> str:
    """The difference and its interval, and for distances the relative difference."""
    metric = METRICS[row.metric]
    text = metric.text(row.difference, "+")
    if np.isfinite(row.low):
        text += f" [{metric.text(row.low, '+')}, {metric.text(row.high, '+')}]"
    return text if metric.of_pictures else f"{text} ({100 * row.relative:+.1f} %)"


def image_lines(collected: Collected, scores: pd.DataFrame, differences: pd.DataFrame, baseline: str) -> list[str]:
    """The section on pictures: how they were scored, both averages, the paired comparison; a sentence if there are none."""
    if "images" not in collected.runs:
        return ["", "No scores of pictures: no run has finished."]
    runs = collected.runs.dropna(subset="images")
    runs = runs.assign(images=runs["images"].map(json.loads))
    runs = runs[[bool(facts) for facts in runs["images"]]]
    if not len(runs):
        return ["", "No scores of pictures: these scenarios have no images, or images.enabled is off."]
    rendered = runs[["failed" not in facts for facts in runs["images"]]]
    pictured = scores[scores["metric"].isin([metric for _, metric in IMAGE_HEADINGS])] if len(scores) else scores
    if not len(rendered) or not len(pictured):
        reasons = sorted({str(facts["failed"]) for facts in runs["images"] if "failed" in facts})
        return ["", f"No scores of pictures: {'; '.join(reasons) or 'no run that can be compared has them'}."]
    have, asked = pictured["scenario"].nunique(), collected.runs["scenario"].nunique()
    some = "" if have == asked else f" Of {asked} scenarios {have} have scores of pictures."
    lines = ["", f"Pictures: PSNR in dB, SSIM and IoU, higher is better; LPIPS, lower is better.{some}", ""]
    lines += [f"{_image_conditions(rendered['images'])} Mean over scenarios; in brackets the frame-weighted mean.", ""]
    lines += _method_table(pictured, collected.runs, runs, IMAGE_HEADINGS, NOT_COMPUTED)
    lines += ["", f"Part of the surface that no camera sees in frame 0: {_unseen(rendered)}."]
    computed = {metric for _, metric in IMAGE_HEADINGS} & set(pictured["metric"])
    where = "in some runs " if "lpips" in computed else ""
    reasons = sorted({str(facts["lpips"]) for facts in rendered["images"]} - {"computed"})
    lines += [line for reason in reasons for line in ("", f"LPIPS {where}not computed: {reason}")]
    own = differences[differences["metric"].isin(computed)] if len(differences) else differences
    if len(own):
        headings = {key: text for key, text in IMAGE_HEADINGS.items() if key[1] in computed}
        lines += ["", f"Paired difference to {baseline} [95 % interval], same scenario and seed:", ""]
        lines += by_method(own, headings, _interval)
    return lines


def marked_lines(scores: pd.DataFrame, runs: pd.DataFrame) -> list[str]:
    """The section on points that were marked in images; nothing where there are none."""
    headings = {key: text for key, text in MARKED_HEADINGS.items() if key in present(scores)} if len(scores) else {}
    if not headings:
        return []
    own = scores[scores["metric"].isin([metric for _, metric in headings])]
    have, asked = own["scenario"].nunique(), runs["scenario"].nunique()
    intro = f"Points marked in images ({have} of {asked} scenarios), lower is better: px in the image; mm on the table."
    return ["", intro, "", *_method_table(own, runs, runs[runs["scenario"].isin(own["scenario"])], headings)]


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


def per_scenario_text(scores: pd.DataFrame) -> str:
    """One line per scenario and method, seeds averaged, in Markdown; errors in mm."""
    rows, headings = [], headings_of(scores)
    for (scenario, method), part in scores.groupby(["scenario", "method"], sort=False):
        means = part.groupby(["task", "metric"])["value"].mean()
        cells = [METRICS[key[1]].text(means[key]) if key in means else DASH for key in headings]
        rows.append([str(scenario), str(method), *cells])
    return "\n".join(markdown(["Scenario", "Method", *headings.values()], rows)) + "\n"


def timing_text(runs: pd.DataFrame) -> str:
    """Median wall time [s] and peak memory [MB] of each stage per method, in Markdown."""
    stages = [name.removeprefix("seconds_") for name in runs.columns if name.startswith("seconds_")]
    rows = []
    for method, part in runs.groupby("method", sort=False):
        cells = [str(method)]
        for stage in stages:
            seconds = part[f"seconds_{stage}"].dropna() if f"seconds_{stage}" in part else pd.Series(dtype=float)
            memory = part[f"memory_mb_{stage}"].dropna() if f"memory_mb_{stage}" in part else pd.Series(dtype=float)
            text = f"{seconds.median():.1f} s" if len(seconds) else "–"
            cells.append(text + (f", {memory.median():.0f} MB" if len(memory) else ""))
        rows.append(cells)
    return "\n".join(markdown(["Method", *stages], rows)) + "\n"


def draw_clusters(collected: Collected, folder: Path) -> str:
    """Draw clusters.png if at least two methods clusters_<K> have scores; returns the section that names it, else nothing.

    Only pairs of scenario and seed count that every such method finished. A method that finished no run is left out.
    """
    runs = collected.runs[collected.runs["method"].isin(list(cluster_methods(collected.runs["method"])))]
    finished = list(cluster_methods(runs.loc[runs["status"] == "ok", "method"]))
    scores = collected.scores[collected.scores["method"].isin(finished)]
    usable = comparable(Collected(scores, runs[runs["method"].isin(finished)]))
    kept, asked = pairs(usable), pairs(runs)
    note = f"; {kept} of {asked} pairs of scenario\nand seed, those that every K finished" if kept < asked else ""
    if clusters_figure(usable, folder / CLUSTERS, note) is None:
        return ""
    return f"\n## Number of regions\n\n![Chamfer distance against the number of regions K]({CLUSTERS})\n"


def draw_ratios(figures: Judged, folder: Path, size: str) -> str:
    """Draw ratios.png if there is an interval to draw; returns the lines that show it, else nothing. `size` goes into its title."""
    if ratios_figure(figures.ratios, folder / RATIOS, size) is None:
        return ""
    return f"\n![Ratio of every method's errors to the baseline's]({RATIOS})\n"


def transfer_text(collected: Collected, baseline: str, figures: Judged) -> str:
    """The section on transferred twins; nothing if there are none."""
    if not len(collected.runs):
        return ""
    scores, differences = compared(collected, baseline)
    what = "Each twin on other recordings of the same object, all frames after the first: mean over targets, then over sources"
    lines = ["", "## Transfer", "", f"{what} (in brackets weighted by frames). A run is one source and seed.", ""]
    headings = published(TRANSFER_HEADINGS, scores)
    lines += _method_table(scores, collected.runs, collected.runs, headings)
    if len(differences):
        interval = "95 % bootstrap interval over sources and seeds; sources may share targets"
        lines += ["", f"Paired difference to {baseline}, mm [{interval}]:", ""]
        lines += by_method(differences, headings, _interval)
    lines += transfer_lines(figures)
    return "\n".join(lines) + "\n"


def write(
    collected: Collected, baseline: str, folder: Path, transfers: Collected | None = None, judging: Judging | None = None
) -> str:
    """Write the tables of a benchmark, and return the summary.

    Files: scores.csv, scores.parquet, runs.csv, averages.csv, differences.csv, held.csv (failures in the averages), floors.csv
    (errors in frame 0), ratios.csv, aims.csv, seeds.csv (spread over seeds), transfers.csv, summary.md. Where a method can be
    compared on several scenarios, also ratios.png, and with methods clusters_<K>, clusters.png; summary.md shows them.
    """
    scores = collected.scores
    usable, differences = compared(collected, baseline)
    figures = judged(collected, baseline, judging or Judging(), transfers)
    # All files are written every time, empty ones too, so that none is left over from an earlier run.
    failures = both_averages(*collected.comparison.parts)
    tables = {
        "scores": scores,
        "runs": collected.runs,
        "averages": averages(usable) if len(usable) else pd.DataFrame(),
        "differences": differences,
        "held": failures,
        "floors": floors_of(collected.runs),
        "ratios": pd.concat([table for table in (figures.ratios, figures.transferred) if len(table)] or [figures.ratios]),
        "aims": figures.aims,
        "seeds": figures.seeds,
        "transfers": transfers.scores if transfers else pd.DataFrame(columns=list(COLUMNS)),
    }
    for name, table in tables.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
    write_atomically(folder / "scores.parquet", lambda temporary: scores.to_parquet(temporary, index=False))
    summary = summary_text(collected, baseline, differences, figures)
    finished = finished_scores(collected)
    details = per_scenario_text(finished) if len(finished) else "No run has finished.\n"
    size = f"{usable['scenario'].nunique()} scenarios, {usable['seed'].nunique()} seed(s)"
    text = f"# Scores\n\n{summary}{draw_ratios(figures, folder, size)}{failures_text(failures)}"
    text += transfer_text(transfers, baseline, figures) if transfers else ""
    text += draw_clusters(collected, folder)
    text += f"\n## Per scenario (errors in mm, seeds averaged)\n\n{details}"
    text += f"\n## Time and memory (medians)\n\n{timing_text(collected.runs)}"
    write_text(folder / "summary.md", text)
    return summary + failures_text(failures)
