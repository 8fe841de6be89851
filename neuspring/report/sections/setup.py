"""Settings that differ, versions, machines, links to files, and the command for MLflow."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from importlib import metadata

from neuspring import config
from neuspring.config import Config
from neuspring.core.run_record import flat
from neuspring.core.table import Cell, Table
from neuspring.core.text import program
from neuspring.report.blocks import Block, Code, Text
from neuspring.report.data import ReportData, ReportSection, link
from neuspring.report.tables import settings_table, several

PACKAGES = (
    "torch",
    "warp-lang",
    "newton",
    "numpy",
    "scipy",
    "scikit-learn",
    "opencv-python-headless",
    "cma",
    "gsplat",
    "snakemake",
)
WHAT = ("scenarios", "methods", "seeds", "results", "tables")
"""Keys that select runs; all other keys are settings of the runs."""


def setup(material: ReportData) -> list[Block]:
    """Commits, settings, versions, machines, files."""
    runs, settings = material.runs, material.choice.settings
    commits = Counter(run.commit or "unknown" for run in runs)
    counted = ", ".join(
        f"{name[:12]}{'-dirty' * name.endswith('-dirty')} ({several(count, 'run')})" for name, count in sorted(commits.items())
    )
    blocks: list[Block] = (
        [Text(text=f"Git commit of the runs: {counted}.", tone="warn" if len(commits) > 1 else "")] if runs else []
    )
    blocks += settings_table(material.table.runs, material.numbers.name)
    if settings is not None:
        plain, defaults = config.plain(settings), flat(config.plain(Config()))
        changed = {key: value for key, value in flat(plain).items() if defaults.get(key) != value and key not in WHAT}
        rows = [
            [key, *(json.dumps(value, ensure_ascii=False) for value in (defaults.get(key), changed[key]))]
            for key in sorted(changed)
        ]
        blocks.append(Table.of_texts(["Setting", "Default", "Value"], rows, "Settings that differ from the defaults"))
    installed = {package.name: package.version for package in metadata.distributions() if package.name in PACKAGES}
    blocks.append(
        Table.of_texts(["Package", "Version"], sorted(installed.items()), "Package versions on the machine that wrote this page")
    )
    machines = Counter(f"{run.machine}; {run.device}" for run in runs)
    blocks.append(Table.of_texts(["Machine; device", "Runs"], sorted(machines.items()), "Machines of the runs"))
    here, folder = material.output.resolve(), material.results / material.choice.tables
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in (".md", ".csv", ".tex") and "so_far" not in path.parts]
    links = [[Cell(text=material.relative(path), link=link(path, here.parent))] for path in files]
    blocks += [Table(caption="Tables as files", header=["File"], rows=links)] if links else []
    command = shlex.join([program("neuspring"), "ui", "--results", str(material.results)])
    blocks += [Text(text="View all runs in MLflow:"), Code(text=command)]
    return blocks


section = ReportSection(order=50, title="Settings and versions", make=setup)
