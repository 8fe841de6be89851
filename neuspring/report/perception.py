"""Errors of perception on synthetic captures per category, from the records of the stage `judge` (judged.json)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.records import StageRecord
from neuspring.core.table import Table
from neuspring.scores.metrics import DASH

JUDGED_COLUMNS = {
    "mask_iou_object": ("Object IoU", ".3f"),
    "mask_iou_hands": ("Hand IoU", ".3f"),
    "track_median_px": ("Track error, px", ".2f"),
    "track_p95_px": ("95 %", ".1f"),
    "track_survival": ("Tracked to the end", ".0%"),
    "lifted_median_mm": ("Lifted, mm", ".1f"),
    "lifted_p95_mm": ("95 %", ".1f"),
    "trusted_median_mm": ("Trusted, mm", ".1f"),
    "trusted_p95_mm": ("95 %", ".1f"),
    "trusted_share": ("Trusted points", ".0%"),
    "controllers_median_mm": ("Controllers, mm", ".1f"),
    "hull_iou_3": ("Hull IoU, 3 cameras", ".2f"),
    "hull_iou_2": ("2 cameras", ".2f"),
    "hull_iou_1": ("1 camera", ".2f"),
    "hull_distance_3_mm": ("Hull distance (3 cameras), mm", ".1f"),
}


def collect(results: Path, scenarios: Iterable[tuple[str, str]]) -> pd.DataFrame:
    """One row per scenario with a record of the stage `judge`; `scenarios` are pairs of name and category."""
    rows = []
    for name, category in scenarios:
        path = results / name / "perception" / "judged.json"
        if not path.is_file():
            continue
        record = StageRecord.load(path)
        rows.append({"scenario": name, "category": category, **record.facts, "seconds": record.seconds})
    return pd.DataFrame(rows)


def write(table: pd.DataFrame, folder: Path) -> str:
    """Write perception.csv and perception.md; returns the text of perception.md."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "perception.csv", table.to_csv(index=False))
    columns = {key: value for key, value in JUDGED_COLUMNS.items() if key in table}
    groups = {str(name): rows for name, rows in table.groupby("category", sort=True)}
    rows = []
    for name, part in (groups | {"all": table} if len(groups) > 1 else groups).items():
        means = part[list(columns)].mean()
        rows.append(
            [name, len(part), *(DASH if pd.isna(means[key]) else format(means[key], form) for key, (_, form) in columns.items())]
        )
    used = [f"{step}: {', '.join(sorted(set(table[step])))}" for step in ("segment", "track", "sensor") if step in table]
    note = (
        f"Means over scenarios ({'; '.join(used)}). Track error: median over points on the object while they are tracked; "
        "95 %: 95th percentile. Lifted: the error of the same points in 3D. Trusted: the error of lifted points that move like "
        "their neighbors; only these enter losses. Hull: the visual hull of 1 to 3 cameras, compared with the true surface."
    )
    header = ["", "Scenarios", *(heading for heading, _ in columns.values())]
    text = "\n".join(["# Errors of perception", "", note, "", *Table.of_texts(header, rows).markdown(), ""])
    write_text(folder / "perception.md", text)
    return text
