"""Tables of `make`: means over cases with their spread over seeds, cases one by one, paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from neuspring.config.parse import read_yaml
from neuspring.core.job_records import read_jobs
from neuspring.core.records import StageRecord, digest_file
from neuspring.core.table import Table
from results.published.footage.runs import LEFT_OUT, METHODS, PHYSTWIN, STILL, Run

COLUMNS = ("case", "method", "seed", "part", "frame", "metric", "value", "key")
PARTS = ("0", "1/3", "2/3", "last")
"""Places of the drawn frames in a film."""
DASH = "–"
LABELED = {
    "iou_drawn": "IoU with masks drawn by hand",
    "iou_carried": "IoU with masks carried from marks, in cases without drawn ones",
}
DIGITS = {"iou": 3, "iou_drawn": 3, "iou_carried": 3, "psnr": 2, "ssim": 4}
HEADINGS = {"iou": "IoU", "psnr": "PSNR [dB]", "ssim": "SSIM"}
SHORT = {"reconstruction": "Recon.", "future": "Future"}
COMPARED = {
    ("future", "iou"): "Future IoU",
    ("future", "psnr"): "Future PSNR [dB]",
    ("last", "iou_drawn"): "IoU with the drawn mask of the last frame",
}
"""Quantities of which differences are taken."""


def select(table: pd.DataFrame, metric: str, part: str, *, all_cases: bool = False) -> pd.DataFrame:
    """Rows of one quantity: case, method, seed, value; without the cases that take no part in means unless asked for."""
    rows = table[(table["metric"] == metric) & (table["part"].astype(str) == part)]
    return rows if all_cases else rows[~rows["case"].isin(LEFT_OUT)]


def shared(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of the cases that every method in them has: means compare the same films only."""
    counts = rows.groupby("case")["method"].nunique()
    return rows[rows["case"].isin(counts.index[counts == rows["method"].nunique()])]


def _in_means(rows: pd.DataFrame, metric: str, parts: Iterable[str]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows that `select` finds of each part, of the cases shared by all methods; and a line that names the cases left out."""
    found = {part: select(rows, metric, part) for part in parts}
    kept = {part: shared(own) for part, own in found.items()}
    lost = {part: sorted(set(own["case"]) - set(kept[part]["case"])) for part, own in found.items()}
    missing = sorted({case for cases in lost.values() for case in cases})
    return kept, [f"Means leave out {', '.join(missing)}: not every method has them.", ""] if missing else []


def mean_and_spread(rows: pd.DataFrame) -> tuple[float, float, int]:
    """Mean over cases, of means over their seeds; standard deviation of the seeds' means over cases; number of cases.

    The spread is of the seeds that have every case: NaN where there are fewer than two.
    """
    if not len(rows):
        return np.nan, np.nan, 0
    wide = rows.pivot_table(index="case", columns="seed", values="value")
    complete = wide.dropna(axis=1).mean()
    return float(wide.mean(axis=1).mean()), float(complete.std(ddof=1)), len(wide)


def differences(rows: pd.DataFrame, first: str, second: str) -> tuple[float, float, float, int] | None:
    """Mean over cases of first minus second, means over seeds each, with the 95 % t interval over cases, and how many cases.

    The interval is NaN for one case; None where they have no case in common.
    """
    means = rows.groupby(["method", "case"])["value"].mean().unstack("method")
    if first not in means or second not in means:
        return None
    values = (means[first] - means[second]).dropna().to_numpy()
    if not len(values):
        return None
    count, mean = len(values), float(values.mean())
    half = float(stats.t.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count)) if count > 1 else np.nan
    return mean, mean - half, mean + half, count


def cell(rows: pd.DataFrame, digits: int) -> str:
    """Mean and spread, as text."""
    mean, spread, _ = mean_and_spread(rows)
    return _text(mean, digits) + ("" if np.isnan(spread) else f" ± {spread:.{digits}f}")


TITLE = "Twins of color footage beside PhysTwin's published prediction"


def tables(table: pd.DataFrame, notes: Sequence[str], title: str = TITLE) -> list[str]:
    """All tables of the scores; columns as in COLUMNS."""
    lines = [f"# {title}", ""]
    lines += [
        f"{PHYSTWIN} was made from three RGBD cameras and read back from compressed video. It is moved by one shift per case,",
        f'fitted in frame 0. "{STILL}" is the object as seen in frame 0. Pixels of hands count nowhere. Means are over cases that',
        f"every method has, without {', '.join(LEFT_OUT)}; ±: standard deviation over seeds of the mean over cases. PSNR and",
        "SSIM are those of the render stage. PhysTwin's colors are of Gaussians seen by three cameras, in a video: its PSNR says",
        "less than its IoU.",
        "",
        *(line for metric in LABELED for line in _labeled(table, metric)),
        *_means(table),
        *_points(table),
        *_paired(table),
    ]
    if notes:
        lines += ["", "## Notes", "", *(f"- {note}" for note in notes)]
    return lines


def in_order(methods: Iterable[str]) -> list[str]:
    """Names in the order of methods.yaml, others behind; PhysTwin and the still object last."""
    order = list(read_yaml(METHODS)) if METHODS.is_file() else []
    names = sorted(dict.fromkeys(methods), key=lambda name: order.index(name) if name in order else len(order))
    return [name for name in names if name not in (PHYSTWIN, STILL)] + [name for name in (PHYSTWIN, STILL) if name in names]


def _labeled(table: pd.DataFrame, metric: str) -> list[str]:
    """IoU in the four labeled frames, with one kind of masks: means and cases."""
    own_rows = table[table["metric"] == metric]
    if not len(own_rows):
        return []
    means, said = _in_means(own_rows, metric, PARTS)
    rows = []
    for method in in_order(own_rows["method"]):
        own = [part[part["method"] == method] for part in means.values()]
        rows.append([method, str(own[-1]["case"].nunique()), *(cell(part, DIGITS[metric]) for part in own)])
    lines = [f"## {LABELED[metric]}", "", *said, *Table.of_texts(["method", "cases", *PARTS], rows).markdown(), ""]
    rows = []
    for (case, method), own in _by_case(own_rows):
        rows.append([case, method, *(cell(select(own, metric, part, all_cases=True), DIGITS[metric]) for part in PARTS[1:])])
    return [*lines, *Table.of_texts(["case", "method", *PARTS[1:]], rows).markdown(), ""]


def _means(table: pd.DataFrame) -> list[str]:
    keys = [(part, metric) for part in SHORT for metric in HEADINGS]
    own_rows = table[table["metric"].isin(HEADINGS)]
    if not len(own_rows):
        return []
    header, rows = [f"{SHORT[part]} {HEADINGS[metric]}" for part, metric in keys], []
    found = {metric: _in_means(own_rows, metric, SHORT) for metric in HEADINGS}
    said = next((lines for _, lines in found.values() if lines), [])
    for method in in_order(own_rows["method"]):
        own = {(part, metric): found[metric][0][part] for part, metric in keys}
        own = {key: values[values["method"] == method] for key, values in own.items()}
        cells = [cell(values, DIGITS[metric]) for (_, metric), values in own.items()]
        rows.append([method, str(own["future", "iou"]["case"].nunique()), *cells])
    title = "## Means over frames, against carried masks"
    lines = [title, "", *said, *Table.of_texts(["method", "cases", *header], rows).markdown(), ""]
    keys = [key for key in keys if key[1] != "ssim"]
    rows = []
    for (case, method), own in _by_case(own_rows):
        rows.append([case, method, *(cell(select(own, metric, part, all_cases=True), DIGITS[metric]) for part, metric in keys)])
    return [
        *lines,
        *Table.of_texts(["case", "method", *(f"{SHORT[part]} {HEADINGS[metric]}" for part, metric in keys)], rows).markdown(),
        "",
    ]


def _points(table: pd.DataFrame) -> list[str]:
    points = table[table["metric"].str.startswith("points_")]
    if not len(points):
        return []
    keys = [(part, name) for part in ("last", "later") for name in ("median", "mean")]
    titles = {"last": "last frame", "later": "all later frames"}
    header, rows = [*(f"{name}, {titles[part]}" for part, name in keys), "on the table, mm"], []
    found = {(part, name): shared(select(points, f"points_{name}", part)) for part, name in keys}
    for method in in_order(points["method"]):
        own = [values[values["method"] == method] for values in found.values()]
        rows.append([f"mean of {own[0]['case'].nunique()}", method, "", *(cell(values, 1) for values in own), ""])
    for (case, method), own in _by_case(points):
        counts = [f"{select(own, 'points_count', part, all_cases=True)['value'].max():.0f}" for part in ("last", "later")]
        cells = [cell(select(own, f"points_{name}", part, all_cases=True), 1) for part, name in keys]
        rows.append([case, method, " / ".join(counts), *cells, cell(select(own, "points_table", "later", all_cases=True), 1)])
    about = [
        "Pixels; points marked surely in frame 0 and in the frame. PhysTwin's particles cannot be told apart in its video.",
        "On the table: points of flat things, in all later frames in which they touch it.",
    ]
    return ["## Points marked by hand", "", *about, "", *Table.of_texts(["case", "method", "points", *header], rows).markdown(), ""]


def _paired(table: pd.DataFrame) -> list[str]:
    rows = []
    for (part, metric), title in COMPARED.items():
        own, digits = select(table, metric, part), DIGITS[metric]
        names = in_order(own["method"])
        pairs = [(name, PHYSTWIN) for name in names if name != PHYSTWIN]
        pairs += [pair[::-1] for pair in combinations([name for name in names if name not in (PHYSTWIN, STILL)], 2)]
        for first, second in pairs:
            found = differences(own, first, second)
            if found is not None:
                mean, low, high, count = found
                span = DASH if np.isnan(low) else f"[{low:+.{digits}f}, {high:+.{digits}f}]"
                rows.append([title, first, second, f"{mean:+.{digits}f}", span, str(count)])
    if not rows:
        return []
    about = "First minus second, paired by case, means over seeds, with 95 % t intervals over cases."
    header = ["quantity", "first", "second", "difference", "95 % interval", "cases"]
    return ["## Paired differences", "", about, "", *Table.of_texts(header, rows).markdown()]


def _by_case(rows: pd.DataFrame) -> list[tuple[tuple[str, str], pd.DataFrame]]:
    """((case, method), rows), cases in their order, methods in that of tables."""
    pairs = [(case, method) for case in dict.fromkeys(rows["case"]) for method in in_order(rows["method"])]
    found = [(pair, rows[(rows["case"] == pair[0]) & (rows["method"] == pair[1])]) for pair in pairs]
    return [(pair, own) for pair, own in found if len(own)]


def _text(value: float, digits: int) -> str:
    return DASH if np.isnan(value) else f"{value:.{digits}f}"


GROUPS = {
    "masks": (),
    "perception": ("capture", "segment", "track", "lift", "judge", "observe"),
    "search": ("search",),
    "fit": ("fits", "fit", "train"),
    "pictures": ("appearance", "render"),
    "rest": ("rollout", "predict", "score", "transfer"),
}
"""Rules of the workflow by what they are for; masks are carried before it."""
COSTED = "neuspring"
"""Whose cost is shown by scenario."""
UPSTREAM = ("search", "fit", "train", "appearance")
"""Inputs of records that are records of other jobs."""


def group_of(rule: str) -> str:
    """The group of a rule."""
    return next((group for group, rules in GROUPS.items() if rule in rules), "rest")


def minutes_by_job(results: Path) -> dict[str, float]:
    """Processor minutes by the name of a job; jobs that never succeeded are left out."""
    found = {}
    for record in read_jobs(results, damaged=[]):
        good = [attempt for attempt in record.attempts if attempt.outcome == "ok"]
        if good:
            found[record.name] = good[-1].cpu_seconds / 60
    return found


def records_of(scenario: Path) -> dict[str, Path]:
    """Paths of the stage records of a scenario that other stages read, by digest."""
    return {digest_file(path): path for name in UPSTREAM for path in sorted(scenario.glob(f"*/*/{name}.json"))}


def jobs_of_run(run: Run, known: Mapping[str, Path]) -> set[str]:
    """Names that the jobs of a run may have, perception left out.

    Records name their inputs by digest. From the records beside run.json they lead to the search, the fit and the splats.
    """
    waiting = [path for name in ("rollout", "render", "fit", "train") if (path := run.folder / f"{name}.json").is_file()]
    visited: set[Path] = set()
    jobs = {f"{rule}/{run.scenario.name}/{run.method}/{run.seed}" for rule in ("rollout", "predict", "score")}
    while waiting:
        path = waiting.pop()
        if path in visited:
            continue
        visited.add(path)
        # A folder search-NAME belongs to the row NAME of searches.yaml.
        folder = path.parent.parent.name.removeprefix("search-") if path.stem == "search" else path.parent.parent.name
        jobs.add(f"{path.stem}/{run.scenario.name}/{folder}/{path.parent.name}")
        inputs = StageRecord.load(path).inputs
        waiting += [known[digest] for role, digest in inputs.items() if role in UPSTREAM and digest in known]
    return jobs


def together(path: Path) -> float:
    """Processor minutes of a fit before its own job: its share of what ran together with others; NaN: not recorded."""
    facts = StageRecord.load(path).facts if path.is_file() else {}
    known = "earlier_processor_seconds" in facts or not facts.get("epochs_together")
    return float(facts.get("earlier_processor_seconds", 0.0)) / 60 if known else np.nan


def costs(results: Path, runs: Sequence[Run], carrying: Mapping[Path, float] | None = None) -> pd.DataFrame:
    """Processor minutes of every run: columns scenario, method, seed, group, minutes. What runs share counts in each of them.

    `carrying`: processor seconds that the masks of a scenario's folder took to be carried, NaN where that is not known.
    """
    minutes, rows = minutes_by_job(results), []
    for scenario in dict.fromkeys(run.scenario for run in runs):
        known = records_of(scenario)
        seen = {name: value for name, value in minutes.items() if _scenario(name) == scenario.name}
        perception = sum(value for name, value in seen.items() if group_of(_rule(name)) == "perception")
        for run in (run for run in runs if run.scenario == scenario):
            own = jobs_of_run(run, known)
            identity = {"scenario": scenario.name, "method": run.method, "seed": run.seed}
            rows.append(identity | {"group": "masks", "minutes": (carrying or {}).get(scenario, np.nan) / 60})
            rows.append(identity | {"group": "perception", "minutes": perception})
            for group in (group for group in GROUPS if group not in ("masks", "perception")):
                total = sum(value for name, value in seen.items() if name in own and group_of(_rule(name)) == group)
                earlier = together(run.folder / "fit.json") if group == "fit" else 0.0
                rows.append(identity | {"group": group, "minutes": total + earlier})
    return pd.DataFrame(rows, columns=["scenario", "method", "seed", "group", "minutes"])


def merged(costs: pd.DataFrame, earlier: pd.DataFrame) -> pd.DataFrame:
    """Costs, and those of an earlier call of runs that these do not have; by scenario, and methods in the order of methods.yaml."""
    names = ["scenario", "method", "seed"]
    there = set(costs[names].itertuples(index=False, name=None))
    rest = [row not in there for row in earlier[names].itertuples(index=False, name=None)]
    both = pd.concat([costs, earlier[rest]], ignore_index=True)
    order = in_order(both["method"])
    return both.sort_values(names, key=lambda column: column.map(order.index) if column.name == "method" else column, kind="stable")


def cost_lines(table: pd.DataFrame) -> list[str]:
    """Tables of processor minutes of one run, mean over its seeds: by method, and of COSTED by scenario, or of the last method."""
    if not len(table):
        return []
    lines = ["", "## Cost: processor minutes of one run", ""]
    lines += [
        "Mean over runs. What runs share (masks, perception, a search, splats) counts in each of them. Fits that ran together have"
    ]
    lines += ["their shares of the processor time; – is not recorded, and is missing in the sum.", ""]
    lines += Table.of_texts(["method", "runs", *GROUPS, "sum"], _minutes(table, "method")).markdown()
    shown = COSTED if (table["method"] == COSTED).any() else table["method"].iloc[-1]
    lines += ["", f"The same of `{shown}`, by scenario:", ""]
    lines += Table.of_texts(["scenario", "runs", *GROUPS, "sum"], _minutes(table[table["method"] == shown], "scenario")).markdown()
    return lines


def _minutes(table: pd.DataFrame, by: str) -> list[list[str]]:
    """Rows of text: a name, how many runs it has, minutes of each group and their sum."""
    wide = table.pivot_table(index=by, columns="group", values="minutes", sort=False).reindex(columns=list(GROUPS))
    counts = table.groupby(by)[["scenario", "method", "seed"]].apply(lambda part: len(part.drop_duplicates()))
    return [
        [str(name), str(counts[name]), *("–" if np.isnan(v) else f"{v:.1f}" for v in row), f"{row.sum():.1f}"]
        for name, row in wide.iterrows()
    ]


def _rule(job: str) -> str:
    return job.split("/")[0]


def _scenario(job: str) -> str:
    parts = job.split("/")
    return parts[1] if len(parts) > 1 else ""
