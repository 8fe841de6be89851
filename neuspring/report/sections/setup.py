"""Settings that differ from the defaults, versions, machines, and files beside the page."""

from __future__ import annotations

import json
import platform
from collections import Counter
from collections.abc import Iterable
from importlib import metadata

import yaml

from neuspring import config
from neuspring.config import Config
from neuspring.core.run_record import RunRecord, flat
from neuspring.core.table import Cell, Table
from neuspring.core.text import listed
from neuspring.report.blocks import Block, Code, Fold, PageSection, Text
from neuspring.report.data import Options, ReportData, ReportSection, link, several

DATA = (".md", ".csv", ".tex", ".html", ".parquet")
SO_FAR = "so_far"
"""Folder of tables that an interrupted run left."""


def files(material: ReportData) -> list[Cell]:
    """Files of the tables' folder beside the report, with links."""
    folder, here = material.results / material.choice.tables, material.output.resolve()
    paths = (path for path in sorted(folder.rglob("*")) if path.suffix in DATA and path.resolve() != here)
    paths = (path for path in paths if path.is_file() and SO_FAR not in path.relative_to(folder).parts)
    return [Cell(text=material.relative(path), link=link(path, here.parent)) for path in paths]


PACKAGES = (
    *("torch", "warp-lang", "newton", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "cma"),
    *("gsplat", "snakemake", "mlflow"),
)
WHAT = ("scenarios", "methods", "seeds", "results", "tables")
"""Keys that say what the benchmark is, not how it runs."""
DIRTY = "-dirty"


def setup(material: ReportData) -> PageSection:
    """Configuration, versions, machines, files."""
    blocks: list[Block] = [_commits(material.runs)] if material.runs else []
    blocks += _settings(material.choice)
    installed = {found.name: found.version for found in metadata.distributions() if found.name in PACKAGES}
    rows = [("python", platform.python_version()), *((name, installed[name]) for name in PACKAGES if name in installed)]
    blocks.append(Table.of_texts(["Package", "Version"], rows, "Versions where this page was written"))
    if machines := Counter(f"{run.machine}; {run.device}" for run in material.runs):
        rows = [(name, str(count)) for name, count in sorted(machines.items())]
        blocks.append(Table.of_texts(["Machine; device", "Runs"], rows, "Machines of the runs"))
    if beside := files(material):
        links = Table(header=["File"], rows=[[one] for one in beside])
        blocks.append(Fold(summary=f"{several(len(beside), 'file')} with the tables' data, beside this page", blocks=[links]))
    return PageSection(key="setup", title="Configuration and versions", blocks=blocks)


def _commits(runs: Iterable[RunRecord]) -> Text:
    """The code that made the runs, with a warning if it was not the same for all."""
    own = Counter(run.commit or "unknown" for run in runs)
    names = [f"{_short(name)} ({several(count, 'run')})" for name, count in sorted(own.items())]
    if len(own) > 1:
        text = f"Runs were made by {len(own)} states of the code: {listed(names)}. Compare with care."
        return Text(text=text, tone="warn")
    (name,) = own
    if name == "unknown":
        return Text(text="Runs do not say by which commit they were made: they were not run from a working copy.", tone="mute")
    if name.endswith(DIRTY):
        return Text(text=f"All runs were made by commit {_short(name)}: with changes that were not committed.", tone="warn")
    return Text(text=f"All runs were made by commit {_short(name)}.")


def _short(name: str) -> str:
    return name[:12] + (DIRTY if name.endswith(DIRTY) else "")


def _settings(choice: Options) -> list[Block]:
    """Settings that differ from the defaults, and all of them; of runs whose configuration is not given, nothing."""
    if choice.settings is None:
        return []
    settings, defaults = config.plain(choice.settings), flat(config.plain(Config()))
    changed = {key: value for key, value in flat(settings).items() if defaults.get(key) != value and key not in WHAT}
    rows = [[key, *(json.dumps(one, ensure_ascii=False) for one in (defaults.get(key), changed[key]))] for key in sorted(changed)]
    table = Table.of_texts(["Setting", "Default", "Here"], rows, "Settings that differ from the defaults")
    text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)
    whole = Fold(summary="Full configuration", blocks=[Code(text=text)])
    return [table if rows else Text(text="All settings have their defaults."), whole]


section = ReportSection(order=110, make=setup)
