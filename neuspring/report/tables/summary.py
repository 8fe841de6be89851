"""Tables from run records: every score, averages per method, paired comparisons, and what failed.

Only files are read (run.json and scores.parquet beside it), never MLflow.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically, write_text
from neuspring.core.records import RECORD_FORMAT, StageRecord, read_json
from neuspring.report.figures.clusters import NAME as CLUSTERS
from neuspring.report.figures.clusters import cluster_methods, clusters_figure
from neuspring.report.figures.ratios import NAME as RATIOS
from neuspring.report.figures.ratios import ratios_figure
from neuspring.scores.failures import NOTHING, LeftOut, applying, both_averages, held_text, kept_line, left_out_lines, removed_lines
from neuspring.scores.layout import HEADINGS, IMAGE_HEADINGS, SHOWN, TRANSFER_HEADINGS, Headings
from neuspring.scores.layout import markdown as markdown
from neuspring.scores.metrics import COLUMNS, averages

RESAMPLES = 10_000
NOT_COMPUTED = "not computed"
RUN_COLUMNS = ("scenario", "method", "seed", "status", "reason", "notes", "images", "source", "run_key")
LISTED = 12
"""As many missing runs are listed one by one."""
DAMAGED = "damaged record: "
"""How the reason of a run begins whose files cannot be read."""


@dataclass(frozen=True)
class Collected:
    """Scores of all runs that have them, and one row per run with its status (ok, failed or missing)."""

    scores: pd.DataFrame
    runs: pd.DataFrame
    held: pd.DataFrame = field(default_factory=lambda: _stacked([]))
    """Scores of failed runs whose prediction stays at its last finite frame; runs of older records have none."""
    left_out: LeftOut = field(default_factory=dict)
    """Method -> the scenarios to which it does not apply, so that it has no runs there."""


def collect(
    results: Path, scenarios: Iterable[str], methods: Iterable[str], seeds: Iterable[int], left_out: LeftOut = NOTHING
) -> Collected:
    """Read the records of every (scenario, method, seed); a run without a record is missing, one with a damaged record failed.

    Where `left_out` says that a method does not apply to a scenario, there is no run at all.
    """
    scenarios, methods = tuple(scenarios), tuple(methods)
    absent = applying(left_out, scenarios, methods)
    tables, rows, held = [], [], []
    for identity, path in _records(results, scenarios, methods, seeds, "run.json"):
        if identity["scenario"] in absent.get(identity["method"], ()):
            continue
        if not path.is_file():
            rows.append(identity | {"status": "missing", "reason": "no run.json: the run has not finished"})
            continue
        try:
            facts, scores, kept = _run(path)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            facts = {"status": "failed", "reason": f"{DAMAGED}{' '.join(str(error).split()) or type(error).__name__}"}
        else:
            tables.append(scores)
            held.append(kept)
        rows.append(identity | facts)
    columns = dict.fromkeys([*RUN_COLUMNS, *(name for row in rows for name in row)])
    runs = pd.DataFrame(rows, columns=list(columns))
    runs = runs.fillna(dict.fromkeys(("notes", "source", "run_key"), ""))
    return Collected(_stacked(tables), runs, _stacked(held), absent)


def read_scores(path: Path) -> Collected:
    """The runs of a scores.csv that `write` wrote, as the runs.csv beside it says how they ended. Raises InputError.

    Without that file a run counts as finished if it has an error for every task that any run has: one that diverged has fewer.
    """
    try:
        scores = pd.read_csv(path)
        scores = scores[list(COLUMNS)].astype({"value": float, "seed": int})
    except (OSError, ValueError, KeyError) as error:
        rule = f"must be a scores.csv with the columns {', '.join(COLUMNS)}"
        raise InputError(path, rule, " ".join(str(error).split()), "Take the file from a folder of tables.") from error
    runs = scores[["scenario", "method", "seed"]].drop_duplicates(ignore_index=True)
    beside = path.with_name("runs.csv")
    if beside.is_file():
        table = pd.read_csv(beside).reindex(columns=[*RUN_COLUMNS, "averaged"])
        return Collected(scores, table.fillna(dict.fromkeys(("reason", "notes", "source", "run_key"), "") | {"averaged": 1}))
    errors = scores[scores["metric"] == "chamfer"]
    tasks = runs.merge(errors.groupby(["scenario", "method", "seed"])["task"].nunique().reset_index(), how="left")["task"]
    finished = tasks == errors["task"].nunique()
    runs["status"] = np.where(finished, "ok", "failed")
    runs["reason"] = np.where(finished, "", "its scores are not complete")
    nothing = {"notes": "", "images": "null", "run_key": ""}
    return Collected(scores, runs.assign(source=path.name, averaged=1, **nothing))


def _run(path: Path) -> tuple[dict[str, Any], pd.DataFrame, pd.DataFrame]:
    """What a table needs of a run.json, its scores, and those of a failed run's held prediction.

    Raises OSError, ValueError, KeyError, TypeError for a damaged one.
    """
    record = read_json(path, RECORD_FORMAT)
    facts = {name: record[name] for name in ("status", "reason", "source", "run_key")} | {"notes": "; ".join(record["notes"])}
    facts |= {f"seconds_{name}": value for name, value in record["timings"].items()}
    facts |= {f"memory_mb_{name}": value for name, value in record.get("peak_memory_mb", {}).items()}
    facts |= {"averaged": record.get("params", {}).get("rollout.result.averaged", 1), "images": json.dumps(record.get("images"))}
    facts["settings"] = json.dumps({name: _digest(values) for name, values in record.get("settings", {}).items()})
    held = record.get("held_file") if record["status"] == "failed" else None
    files = (record["scores_file"], held)
    scores, kept = (pd.read_parquet(path.parent / name)[list(COLUMNS)] if name else _stacked([]) for name in files)
    return facts, scores, kept


def _digest(settings: Any) -> str:
    """Of a stage's settings, whatever its seed."""
    if isinstance(settings, dict):
        settings = {name: value for name, value in settings.items() if name != "seed"}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def mixed_settings(runs: pd.DataFrame) -> str:
    """A warning if finished runs of a method were made with different settings, as when `only` renewed a part; else nothing."""
    if "settings" not in runs:
        return ""
    mixed: dict[str, list[str]] = {}
    for method, part in runs[runs["status"] == "ok"].groupby("method", sort=False):
        stages = pd.DataFrame([json.loads(text) for text in part["settings"].dropna() if text])
        for stage in (name for name in stages if stages[name].nunique() > 1):
            mixed.setdefault(str(stage), []).append(str(method))
    where = "; ".join(f"{stage} of {', '.join(methods)}" for stage, methods in mixed.items())
    return f"Runs were made with different settings ({where}): make the older ones again before they are compared." if mixed else ""


def collect_transfers(results: Path, sources: Iterable[str], methods: Iterable[str], seeds: Iterable[int]) -> Collected:
    """Transferred twins as runs: `scenario` is the source, whose score is the mean over its targets."""
    tables, rows = [], []
    for identity, path in _records(results, sources, methods, seeds, "transfer.json"):
        if not path.is_file():
            continue
        try:
            record = StageRecord.load(path)
        except InputError as error:
            rows.append(identity | {"status": "failed", "reason": f"{DAMAGED}{error}", "notes": ""})
            continue
        diverged = record.facts.get("diverged", [])
        reason = record.reason or ", ".join(f"diverged on {name}" for name in diverged)
        status = "ok" if record.status == "ok" and not diverged else "failed"
        rows.append(identity | {"status": status, "reason": reason, "notes": ""})
        table = pd.read_parquet(record.file("scores", path))
        keys = ["category", "method", "seed", "task", "metric", "unit"]
        mean = table.groupby(keys, sort=False).agg(value=("value", "mean"), frames=("frames", "sum")).reset_index()
        tables.append(mean.assign(scenario=identity["scenario"])[list(COLUMNS)])
    return Collected(_stacked(tables), pd.DataFrame(rows))


def _records(
    results: Path, scenarios: Iterable[str], methods: Iterable[str], seeds: Iterable[int], name: str
) -> Iterator[tuple[dict[str, Any], Path]]:
    """(scenario, method and seed; path of its record `name`) for every combination."""
    for scenario, method, seed in product(scenarios, methods, seeds):
        yield {"scenario": scenario, "method": method, "seed": seed}, Path(results) / scenario / method / str(seed) / name


def _stacked(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """One table of scores; empty ones are left out, since they carry no column types."""
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=list(COLUMNS))


def comparable(collected: Collected) -> pd.DataFrame:
    """Scores of the (scenario, seed) pairs that every method finished, so that averages compare like with like.

    A method that finished no run at all (yet) takes no part. `tables_held.removed_lines` says whose failures remove pairs, and
    which methods do not apply to some scenarios.
    """
    good = collected.runs[collected.runs["status"] == "ok"]
    methods = good["method"].nunique()
    complete = good.groupby(["scenario", "seed"])["method"].nunique()
    pairs = complete[complete == methods].index
    keep = pd.MultiIndex.from_frame(collected.scores[["scenario", "seed"]]).isin(pairs)
    return collected.scores[keep & collected.scores["method"].isin(good["method"])]


def paired_differences(scores: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """Method minus baseline on the same scenario and seed: mean, and a 95 % bootstrap interval over scenarios and seeds.

    Scenarios are resampled, and within each the seeds, since runs of one scenario are not independent. `relative` is the mean
    difference over the baseline's mean on the same pairs; `ratio` the geometric mean of method / baseline, with its interval,
    in which a scenario of large errors weighs no more than another (NaN where an error is zero).
    """
    rows = []
    rng = np.random.default_rng(0)
    for (task, metric), part in scores.groupby(["task", "metric"], sort=False):
        wide = part.pivot_table(index=["scenario", "seed"], columns="method", values="value")
        for method in wide.columns.drop(baseline, errors="ignore"):
            if baseline not in wide:
                continue
            both = wide[[method, baseline]].dropna()
            if not len(both):
                continue
            difference, low, high = _mean_interval(both[method] - both[baseline], rng)
            base = both[baseline].groupby("scenario").mean()
            row = {"method": method, "baseline": baseline, "task": task, "metric": metric, "difference": difference}
            row |= {"low": low, "high": high, "relative": difference / base.mean(), "scenarios": len(base)}
            positive = bool((both > 0).all(axis=None))
            ratios = np.exp(_mean_interval((both[method] / both[baseline]).map(math.log), rng)) if positive else [np.nan] * 3
            rows.append(row | dict(zip(("ratio", "ratio_low", "ratio_high"), ratios, strict=True)))
    return pd.DataFrame(rows)


def _mean_interval(values: pd.Series, rng: np.random.Generator) -> tuple[float, float, float]:
    """Mean over scenarios of `values` by (scenario, seed), and its 95 % bootstrap interval (NaN for one scenario)."""
    runs = [part.to_numpy() for _, part in values.groupby("scenario")]
    mean = float(np.mean([part.mean() for part in runs]))
    if len(runs) == 1:
        return mean, np.nan, np.nan
    low, high = np.quantile(_resampled_means(runs, rng), [0.025, 0.975])
    return mean, float(low), float(high)


def _resampled_means(runs: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Means over resampled scenarios, each with resampled seeds of its own [RESAMPLES]; `runs` has one array a scenario."""
    counts = np.array([len(part) for part in runs])
    padded = np.stack([np.resize(part, counts.max()) for part in runs])
    total = np.zeros(RESAMPLES)
    for _ in runs:
        scenario = rng.integers(len(runs), size=RESAMPLES)
        seed = (rng.random((RESAMPLES, counts.max())) * counts[scenario, None]).astype(int)
        used = np.arange(counts.max()) < counts[scenario, None]
        total += (padded[scenario[:, None], seed] * used).sum(axis=1) / counts[scenario]
    return total / len(runs)


def summary_text(collected: Collected, baseline: str, differences: pd.DataFrame | None = None) -> str:
    """The tables in Markdown, in millimetres: both averages, the paired comparison, failures.

    `differences` are the paired ones if the caller has them already, since the bootstrap takes seconds on a large benchmark.
    """
    methods = list(dict.fromkeys(collected.runs["method"]))
    scores = comparable(collected)
    counts = collected.runs.groupby(["method", "status"]).size().unstack(fill_value=0)
    scenarios, seeds = collected.runs["scenario"].nunique(), collected.runs["seed"].nunique()
    size = f"{scenarios} scenario{'s' * (scenarios > 1)}, {seeds} seed{'s' * (seeds > 1)}"
    several = _several_seeds(scores)
    spread = ", ± standard deviation over seeds" if several else ""
    lines = [f"Errors in mm, lower is better ({size}; CD: single-directional L1 Chamfer; TE: track error).", ""]
    lines += [f"Mean over scenarios{spread}; in brackets the frame-weighted mean.", ""]
    if removed := removed_lines(collected.runs, collected.left_out):
        lines += [" ".join([kept_line(scores, collected.runs), *removed]), ""]
    if warning := mixed_settings(collected.runs):
        lines += [f"**{warning}**", ""]
    lines += _method_table(methods, averages(scores) if len(scores) else pd.DataFrame(), counts, several)
    if differences is None:
        differences = paired_differences(scores, baseline) if len(scores) else pd.DataFrame()
    if len(differences):
        lines += [
            "",
            f"Paired difference to {baseline}, mm [95 % bootstrap interval over scenarios and seeds], same scenario and seed:",
            "",
        ]
        lines += _difference_table(differences)
        lines += ["", f"Ratio to {baseline}, geometric mean [95 % interval], which no single scenario of large errors decides:", ""]
        lines += _difference_table(differences, cell=_ratio)
    lines += image_lines(collected, scores, differences, baseline)
    bad = collected.runs[collected.runs["status"] != "ok"]
    if len(bad):
        lines += ["", "Not in the averages:", "", *_not_counted(bad)]
    lines += [line for text in left_out_lines(collected.left_out) for line in ("", text)]
    lines += _averaged_notes(collected.runs)
    noted = collected.runs[collected.runs["notes"] != ""]
    if len(noted):
        lines += ["", "Notes:", ""]
        lines += [f"- {row.scenario} / {row.method} / seed {row.seed}: {row.notes}" for row in noted.itertuples()]
    return "\n".join(lines) + "\n"


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


def _averaged_notes(runs: pd.DataFrame) -> list[str]:
    """What a reader must know of methods whose prediction is a mean over seeds."""
    if "averaged" not in runs:
        return []
    counts = runs.groupby("method", sort=False)["averaged"].max()
    same = "the same one for every seed; it costs as many fits, of which the times below show one"
    return [
        line
        for method, count in counts[counts > 1].items()
        for line in ("", f"{method} is the mean of {count:.0f} seeds' predictions, {same}.")
    ]


def _method_table(
    methods: list[str],
    means: pd.DataFrame,
    counts: pd.DataFrame,
    several: bool,
    headings: Headings = HEADINGS,
    absent: str = "–",
) -> list[str]:
    rows = []
    for method in methods:
        cells = [method]
        for task, metric in headings:
            found = (
                means[(means["method"] == method) & (means["task"] == task) & (means["metric"] == metric)] if len(means) else means
            )
            if not len(found):
                cells.append(absent)
                continue
            row, (factor, digits) = found.iloc[0], SHOWN[metric]
            spread = f" ± {factor * row['seed_std']:.{digits}f}" if np.isfinite(row["seed_std"]) else " ± –"
            spread = spread if several else ""
            cells.append(f"{factor * row['equal']:.{digits}f}{spread} ({factor * row['frames']:.{digits}f})")
        status = {str(name): int(value) for name, value in counts.loc[method].to_dict().items()}
        failed = f" ({status['failed']} failed)" if status.get("failed") else ""
        cells.append(f"{status.get('ok', 0)}/{sum(status.values())}{failed}")
        rows.append(cells)
    return markdown(["Method", *headings.values(), "Runs"], rows)


def _difference_table(
    differences: pd.DataFrame, headings: Headings = HEADINGS, cell: Callable[[Any], str] | None = None
) -> list[str]:
    rows = []
    for method, part in differences.groupby("method", sort=False):
        cells = [str(method)]
        for task, metric in headings:
            found = part[(part["task"] == task) & (part["metric"] == metric)]
            cells.append("–" if not len(found) else (cell or _interval)(found.iloc[0]))
        rows.append(cells)
    return markdown(["Method", *headings.values()], rows)


def _interval(row: Any) -> str:
    return f"{_plain_interval(row)} ({100 * row['relative']:+.1f} %)"


def _plain_interval(row: Any) -> str:
    """Without the relative difference, which means nothing in dB."""
    factor, digits = SHOWN[row["metric"]]
    text = f"{factor * row['difference']:+.{digits}f}"
    if np.isfinite(row["low"]):
        text += f" [{factor * row['low']:+.{digits}f}, {factor * row['high']:+.{digits}f}]"
    return text


def _ratio(row: Any) -> str:
    if not np.isfinite(row["ratio"]):
        return "–"
    interval = f" [{row['ratio_low']:.3f}, {row['ratio_high']:.3f}]" if np.isfinite(row["ratio_low"]) else ""
    return f"{row['ratio']:.3f}{interval}"


def image_lines(collected: Collected, scores: pd.DataFrame, differences: pd.DataFrame, baseline: str) -> list[str]:
    """The section on pictures: how they were scored, both averages, the paired comparison; a sentence if there are none."""
    if "images" not in collected.runs:
        return ["", "No scores of pictures: no run has finished."]
    runs = collected.runs.dropna(subset="images")
    runs = runs.assign(images=runs["images"].map(json.loads))
    runs = runs[[bool(facts) for facts in runs["images"]]]
    if not len(runs):
        return ["", "No scores of pictures: these scenarios have no images, or images.enabled is off."]
    drawn = runs[["failed" not in facts for facts in runs["images"]]]
    pictured = scores[scores["metric"].isin([metric for _, metric in IMAGE_HEADINGS])] if len(scores) else scores
    if not len(drawn) or not len(pictured):
        reasons = sorted({str(facts["failed"]) for facts in runs["images"] if "failed" in facts})
        return ["", f"No scores of pictures: {'; '.join(reasons) or 'no run that can be compared has them'}."]
    have, all_ = pictured["scenario"].nunique(), collected.runs["scenario"].nunique()
    some = "" if have == all_ else f" Of {all_} scenarios {have} have scores of pictures."
    lines = ["", f"Pictures: PSNR in dB, SSIM and IoU, higher is better; LPIPS, lower is better.{some}", ""]
    lines += [f"{_image_conditions(drawn['images'])} Mean over scenarios; in brackets the frame-weighted mean.", ""]
    methods = list(dict.fromkeys(collected.runs["method"]))
    counts = runs.groupby(["method", "status"]).size().unstack(fill_value=0).reindex(methods, fill_value=0)
    lines += _method_table(methods, averages(pictured), counts, _several_seeds(pictured), IMAGE_HEADINGS, NOT_COMPUTED)
    lines += ["", f"Part of the surface that no camera sees in frame 0: {_unseen(drawn)}."]
    computed = {metric for _, metric in IMAGE_HEADINGS} & set(pictured["metric"])
    where = "in some runs " if "lpips" in computed else ""
    reasons = sorted({str(facts["lpips"]) for facts in drawn["images"]} - {"computed"})
    lines += [line for reason in reasons for line in ("", f"LPIPS {where}not computed: {reason}")]
    own = differences[differences["metric"].isin(computed)] if len(differences) else differences
    if len(own):
        lines += ["", f"Paired difference to {baseline} [95 % interval], same scenario and seed:", ""]
        lines += _difference_table(own, {key: text for key, text in IMAGE_HEADINGS.items() if key[1] in computed}, _plain_interval)
    return lines


def _unseen(runs: pd.DataFrame) -> str:
    """Scenarios and the share of their surface that frame 0 hides, in words."""
    shares: dict[str, list[float | None]] = {}
    for scenario, facts in zip(runs["scenario"], runs["images"], strict=True):
        shares.setdefault(str(scenario), []).append(facts["unseen_surface"])
    known = {name: [value for value in values if value is not None] for name, values in shares.items()}
    return ", ".join(f"{name} {f'{np.mean(v):.0%}' if v else 'unknown (no shape prior)'}" for name, v in known.items())


def _image_conditions(facts: Iterable[dict[str, Any]]) -> str:
    """How pictures were scored, from the runs' records."""

    def several(name: str) -> str:
        return " and ".join(sorted({", ".join(v) if isinstance(v := values[name], list) else str(v) for values in facts}))

    quirks = several("quirks")
    text = f"Cameras scored: {several('views')}; masks: {several('masks')}; rasteriser: {several('backend')}"
    return f"{text}; released quirks: {quirks}." if quirks.strip() else f"{text}; none of the released evaluation's quirks."


def per_scenario_text(scores: pd.DataFrame) -> str:
    """One line per scenario and method, seeds averaged, in Markdown; errors in mm."""
    rows, known = [], set(zip(scores["task"], scores["metric"], strict=True))
    headings = HEADINGS | {key: text for key, text in IMAGE_HEADINGS.items() if key in known}
    for (scenario, method), part in scores.groupby(["scenario", "method"], sort=False):
        means = part.groupby(["task", "metric"])["value"].mean()
        cells = [f"{SHOWN[key[1]][0] * means[key]:.{SHOWN[key[1]][1]}f}" if key in means else "–" for key in headings]
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


def write_clusters(collected: Collected, folder: Path) -> str:
    """Draw clusters.png if at least two methods clusters_<K> have scores; returns the section that names it, else nothing.

    Only pairs of scenario and seed count that every such method finished, as in the tables; one that finished none is left out.
    """
    runs = collected.runs[collected.runs["method"].isin(list(cluster_methods(collected.runs["method"])))]
    finished = list(cluster_methods(runs.loc[runs["status"] == "ok", "method"]))
    scores = collected.scores[collected.scores["method"].isin(finished)]
    part = Collected(scores, runs[runs["method"].isin(finished)])
    usable = comparable(part) if len(scores) else scores
    pairs, kept = (len(table[["scenario", "seed"]].drop_duplicates()) for table in (runs, usable))
    note = f"; {kept} of {pairs} pairs of scenario\nand seed, those that every K finished" if kept < pairs else ""
    if clusters_figure(usable, folder / CLUSTERS, note) is None:
        return ""
    return f"\n## Number of regions\n\n![Chamfer distance against the number of regions K]({CLUSTERS})\n"


def write_ratios(scores: pd.DataFrame, differences: pd.DataFrame, folder: Path) -> str:
    """Draw ratios.png if there is an interval to draw; returns the lines that show it, else nothing."""
    if len(differences):
        order = list(dict.fromkeys(scores["method"]))
        differences = differences.sort_values("method", key=lambda names: names.map(order.index), kind="stable")
    counts = f"{scores['scenario'].nunique()} scenarios, {scores['seed'].nunique()} seed(s)"
    if ratios_figure(differences, folder / RATIOS, counts) is None:
        return ""
    return f"\n![Ratio of every method's errors to the baseline's]({RATIOS})\n"


def transfer_text(collected: Collected, baseline: str) -> str:
    """The section on transferred twins; nothing if there are none."""
    if not len(collected.runs):
        return ""
    methods = list(dict.fromkeys(collected.runs["method"]))
    scores = comparable(collected)
    counts = collected.runs.groupby(["method", "status"]).size().unstack(fill_value=0)
    what = "Each twin on other recordings of the same object, all frames after the first: mean over targets, then over sources"
    lines = ["", "## Transfer", "", f"{what} (in brackets weighted by frames). A run is one source and seed.", ""]
    means = averages(scores) if len(scores) else pd.DataFrame()
    lines += _method_table(methods, means, counts, _several_seeds(scores), TRANSFER_HEADINGS)
    differences = paired_differences(scores, baseline) if len(scores) else pd.DataFrame()
    if len(differences):
        interval = "95 % bootstrap interval over sources and seeds; sources may share targets"
        lines += ["", f"Paired difference to {baseline}, mm [{interval}]:", ""]
        lines += _difference_table(differences, TRANSFER_HEADINGS)
        lines += ["", f"Ratio to {baseline}, geometric mean [95 % interval]:", ""]
        lines += _difference_table(differences, TRANSFER_HEADINGS, _ratio)
    return "\n".join(lines) + "\n"


def write(collected: Collected, baseline: str, folder: Path, transfers: Collected | None = None) -> str:
    """Write scores.csv, scores.parquet, runs.csv, averages.csv, differences.csv, held.csv, transfers.csv and summary.md; returns
    the summary.

    Where a method can be compared on several scenarios, also ratios.png, and with methods clusters_<K>, clusters.png; summary.md
    shows them.
    """
    scores = collected.scores
    usable = comparable(collected)
    averaged = averages(usable) if len(usable) else pd.DataFrame()
    differences = paired_differences(usable, baseline) if len(usable) else pd.DataFrame()
    # All files are written every time, empty ones too, so that none is left over from an earlier run.
    failures = both_averages(scores, collected.runs, collected.held)
    written = {"scores": scores, "runs": collected.runs, "averages": averaged, "differences": differences, "held": failures}
    for name, table in written.items():
        write_text(folder / f"{name}.csv", table.to_csv(index=False))
    write_atomically(folder / "scores.parquet", lambda temporary: scores.to_parquet(temporary, index=False))
    summary = summary_text(collected, baseline, differences)
    finished = scores.merge(collected.runs.loc[collected.runs["status"] == "ok", ["scenario", "method", "seed"]])
    details = per_scenario_text(finished) if len(finished) else "No run has finished.\n"
    timings = timing_text(collected.runs)
    transferred = transfer_text(transfers, baseline) if transfers else ""
    transfer_scores = transfers.scores if transfers else pd.DataFrame(columns=list(COLUMNS))
    write_text(folder / "transfers.csv", transfer_scores.to_csv(index=False))
    text = f"# Scores\n\n{summary}{write_ratios(usable, differences, folder)}{held_text(failures)}{transferred}"
    text += write_clusters(collected, folder)
    text += f"\n## Per scenario (errors in mm, seeds averaged)\n\n{details}\n## Time and memory (medians)\n\n{timings}"
    write_text(folder / "summary.md", text)
    return summary + held_text(failures)
