"""The table of the 22 released PhysTwin cases: sizes, category, springs."""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources


@cache
def released_cases() -> dict[str, dict[str, str]]:
    """The table of the 22 released cases: case -> column -> text, empty where unknown."""
    text = resources.files("neuspring.data.tables").joinpath("phystwin22.csv").read_text(encoding="utf-8")
    return {row["case"]: row for row in csv.DictReader(text.splitlines())}
