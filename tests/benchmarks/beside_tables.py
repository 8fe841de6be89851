"""Tables of `beside_phystwin`: means over cases with their spread over seeds, cases one by one, paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
import pandas as pd
from scipy import stats

from neuspring.config.parse import read_yaml
from neuspring.core.text import markdown
from tests.benchmarks.beside_data import LEFT_OUT, METHODS, PHYSTWIN, STILL

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
"""What differences are taken of."""


def select(table: pd.DataFrame, metric: str, part: str, *, all_cases: bool = False) -> pd.DataFrame:
    """Rows of one quantity: case, method, seed, value; without the cases that take no part in means unless asked for."""
    rows = table[(table["metric"] == metric) & (table["part"].astype(str) == part)]
    return rows if all_cases else rows[~rows["case"].isin(LEFT_OUT)]


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


def tables(table: pd.DataFrame, notes: Sequence[str]) -> list[str]:
    """All tables of the scores; columns as in COLUMNS."""
    lines = ["# Twins of color footage beside PhysTwin's published prediction", ""]
    lines += [
        f"{PHYSTWIN} was made from three RGBD cameras and read back from compressed video. It is moved by one shift per case,",
        f'fitted in frame 0. "{STILL}" is the object as seen in frame 0. Pixels of hands count nowhere. Means are over cases,',
        f"without {', '.join(LEFT_OUT)}; ±: standard deviation over seeds of the mean over cases. PSNR and SSIM are those of the",
        "render stage. PhysTwin's colors are of Gaussians seen by three cameras, in a video: its PSNR says less than its IoU.",
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
    rows = []
    for method in in_order(own_rows["method"]):
        own = own_rows[own_rows["method"] == method]
        cells = [cell(select(own, metric, part), DIGITS[metric]) for part in PARTS]
        rows.append([method, str(mean_and_spread(select(own, metric, PARTS[-1]))[2]), *cells])
    lines = [f"## {LABELED[metric]}", "", *markdown(["method", "cases", *PARTS], rows), ""]
    rows = []
    for (case, method), own in _by_case(own_rows):
        rows.append([case, method, *(cell(select(own, metric, part, all_cases=True), DIGITS[metric]) for part in PARTS[1:])])
    return [*lines, *markdown(["case", "method", *PARTS[1:]], rows), ""]


def _means(table: pd.DataFrame) -> list[str]:
    keys = [(part, metric) for part in SHORT for metric in HEADINGS]
    own_rows = table[table["metric"].isin(HEADINGS)]
    if not len(own_rows):
        return []
    header, rows = [f"{SHORT[part]} {HEADINGS[metric]}" for part, metric in keys], []
    for method in in_order(own_rows["method"]):
        own = own_rows[own_rows["method"] == method]
        cells = [cell(select(own, metric, part), DIGITS[metric]) for part, metric in keys]
        rows.append([method, str(mean_and_spread(select(own, "iou", "future"))[2]), *cells])
    lines = ["## Means over frames, against carried masks", "", *markdown(["method", "cases", *header], rows), ""]
    keys = [key for key in keys if key[1] != "ssim"]
    rows = []
    for (case, method), own in _by_case(own_rows):
        rows.append([case, method, *(cell(select(own, metric, part, all_cases=True), DIGITS[metric]) for part, metric in keys)])
    return [*lines, *markdown(["case", "method", *(f"{SHORT[part]} {HEADINGS[metric]}" for part, metric in keys)], rows), ""]


def _points(table: pd.DataFrame) -> list[str]:
    points = table[table["metric"].str.startswith("points_")]
    if not len(points):
        return []
    keys = [(part, name) for part in ("last", "later") for name in ("median", "mean")]
    titles = {"last": "last frame", "later": "all later frames"}
    header, rows = [*(f"{name}, {titles[part]}" for part, name in keys), "on the table, mm"], []
    for method in in_order(points["method"]):
        own = points[points["method"] == method]
        cells = [cell(select(own, f"points_{name}", part), 1) for part, name in keys]
        rows.append([f"mean of {own['case'].nunique()}", method, "", *cells, ""])
    for (case, method), own in _by_case(points):
        counts = [f"{select(own, 'points_count', part, all_cases=True)['value'].max():.0f}" for part in ("last", "later")]
        cells = [cell(select(own, f"points_{name}", part, all_cases=True), 1) for part, name in keys]
        rows.append([case, method, " / ".join(counts), *cells, cell(select(own, "points_table", "later", all_cases=True), 1)])
    about = [
        "Pixels; points marked surely in frame 0 and in the frame. PhysTwin's particles cannot be told apart in its video.",
        "On the table: points of flat things, in all later frames in which they touch it.",
    ]
    return ["## Points marked by hand", "", *about, "", *markdown(["case", "method", "points", *header], rows), ""]


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
    return ["## Paired differences", "", about, "", *markdown(header, rows)]


def _by_case(rows: pd.DataFrame) -> list[tuple[tuple[str, str], pd.DataFrame]]:
    """((case, method), rows), cases in their order, methods in that of tables."""
    pairs = [(case, method) for case in dict.fromkeys(rows["case"]) for method in in_order(rows["method"])]
    found = [(pair, rows[(rows["case"] == pair[0]) & (rows["method"] == pair[1])]) for pair in pairs]
    return [(pair, own) for pair, own in found if len(own)]


def _text(value: float, digits: int) -> str:
    return DASH if np.isnan(value) else f"{value:.{digits}f}"
