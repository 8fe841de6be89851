"""Rows, text and file of the table, its change against the committed table, and the kind of a machine."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core.files import write_text
from neuspring.core.provenance import commit
from neuspring.core.table import Table

ROOT = Path(__file__).parents[3]
COMMITTED = "results/published/bench"
"""Folder of committed tables, one file per kind of machine."""
SCRATCH = "results/bench"
"""Folder of tables without --save."""
HEADER = ["section", "row", "device", "nodes", "springs", "substeps", "batch", "median", "least", "ns", "ratio", "to", "change"]
LEGEND = """ns: median per spring, substep and twin. ratio: ns over that of the row in the next column, median of the rounds.
change: of the median against the committed table of this kind of machine."""


def facts() -> dict[str, str | int]:
    """Processor, GPU, versions and commit; nothing that identifies the machine."""
    processor = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    return {
        "cpu": entry(processor, "model name") or platform.machine(),
        "cpu_model": entry(processor, "model"),
        "cpu_flags": len(entry(processor, "flags").split()),
        "cores": os.cpu_count() or 1,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "warp": wp.__version__,
        "commit": commit(),
    }


def entry(text: str, name: str) -> str:
    """First value of a name in a text of lines `name : value`; empty without one."""
    found = re.search(rf"^{re.escape(name)}\s*:\s*(.*)$", text, re.MULTILINE)
    return found.group(1).strip() if found else ""


def kind(machine: dict[str, str | int]) -> str:
    """File name of a kind of machine: processor, cores and GPU."""
    cpu = str(machine["cpu"]).replace("(R)", "").replace("(TM)", "")
    words = f"{cpu} {machine['cpu_model']} {machine['cores']} cores {machine['gpu']}"
    return re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One measurement. Names are unique within a section and device."""

    section: str
    name: str
    device: str
    median: float
    least: float
    unit: str = "ms"
    """Unit of `median` and `least`."""
    nodes: int = 0
    springs: int = 0
    substeps: int = 0
    batch: int = 1
    ratio: float | None = None
    """Time per spring, substep and twin (or in `unit`) over that of row `reference` in the same section and device."""
    least_ratio: float | None = None
    reference: str = ""

    @property
    def key(self) -> tuple[str, str, str]:
        """Key of the same row in another table."""
        return self.section, self.name, self.device

    @property
    def nanoseconds(self) -> float | None:
        """Median time per spring, substep and twin, ns."""
        return 1e6 * self.median / (self.springs * self.substeps * self.batch) if self.unit == "ms" and self.springs else None


def as_record(machine: dict[str, Any], rows: Sequence[Row], notes: Sequence[str]) -> dict[str, Any]:
    """Content of a file."""
    table = [asdict(row) | {"nanoseconds": row.nanoseconds} for row in rows]
    return {"machine": machine, "rows": table, "notes": list(notes)}


def save(record: dict[str, Any], kind: str, *, committed: bool) -> Path:
    """Write a table into one of the two folders; return its path."""
    path = ROOT / (COMMITTED if committed else SCRATCH) / f"{kind}.json"
    write_text(path, json.dumps(record, indent=1) + "\n")
    return path


def last_kept(kind: str) -> dict[str, Any] | None:
    """The committed table of a kind of machine; None without one."""
    path = ROOT / COMMITTED / f"{kind}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def medians(record: dict[str, Any]) -> dict[tuple[str, str, str], tuple[float, str]]:
    """`Row.key` -> (median, unit) for the rows of a file."""
    return {(row["section"], row["name"], row["device"]): (float(row["median"]), str(row["unit"])) for row in record["rows"]}


def change(row: Row, before: dict[tuple[str, str, str], tuple[float, str]]) -> float | None:
    """Relative change of the median (-0.1: 10 % less); None for a new row."""
    median, unit = before.get(row.key, (0.0, ""))
    return row.median / median - 1 if median > 0 and unit == row.unit else None


def text(rows: Sequence[Row], committed: dict[str, Any] | None) -> str:
    """The printed table."""
    before = medians(committed) if committed else {}
    cells = [[*_facts(row), _signed(change(row, before))] for row in rows]
    return "\n".join(Table.of_texts(HEADER, cells).markdown())


def _facts(row: Row) -> list[str]:
    counts = [str(count) if count else "" for count in (row.nodes, row.springs, row.substeps)]
    batch = str(row.batch) if row.springs else ""
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    times = [f"{row.median:.4g} {row.unit}", f"{row.least:.4g}", "" if row.nanoseconds is None else f"{row.nanoseconds:.2f}"]
    return [row.section, row.name, row.device, *counts, batch, *times, ratio, row.reference]


def _signed(relative: float | None) -> str:
    return "" if relative is None else f"{100 * relative:+.0f} %"
