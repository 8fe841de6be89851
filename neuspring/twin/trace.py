"""The record of a search on disk, from which a killed one is continued."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core.files import write_atomically


def save(path: Path, key: str, trace: list[dict[str, Any]], attempts: int, seconds: float) -> None:
    """Write the rows of a trace, with what they were made from."""
    table = pd.DataFrame(trace)
    table.attrs |= {"key": key, "attempts": attempts, "seconds": seconds}
    write_atomically(path, lambda p: table.to_parquet(p))


def recorded(path: Path | None, key: str) -> tuple[list[dict[str, Any]], int, float]:
    """(rows of the trace, attempts, seconds) of a recorded search with this key; (none, 1, 0) if there is none."""
    fresh: tuple[list[dict[str, Any]], int, float] = ([], 1, 0.0)
    if path is None or not path.is_file():
        return fresh
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        print(f"{path}: unreadable ({error}); the search starts afresh")
        return fresh
    if table.attrs.get("key") != key:
        print(f"{path}: made with other inputs or settings; the search starts afresh")
        return fresh
    print(f"continuing the search after {len(table)} rollouts")
    records = [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]
    return records, int(table.attrs["attempts"]) + 1, float(table.attrs["seconds"])


def replays(rows: list[dict[str, Any]], population: list[np.ndarray], variables: tuple[str, ...]) -> bool:
    """Whether recorded candidates are those that CMA-ES proposes now."""
    return all(
        np.array_equal(np.array([row.get(f"normalized.{name}", np.nan) for name in variables]), normalized)
        for row, normalized in zip(rows, population, strict=False)
    )
