"""Settings that differ from the defaults, versions, machines, and files beside the page."""

from __future__ import annotations

import json
import platform
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

import yaml

from neuspring import config
from neuspring.config import Config
from neuspring.core.run_record import RunRecord, flat
from neuspring.core.table import Cell, Table
from neuspring.core.text import listed
from neuspring.report.blocks import Block, Code, Fold, Items, Link, PageSection, Text
from neuspring.report.data import ReportData, ReportSection, link, several

DATA = (".md", ".csv", ".tex", ".html", ".parquet")
SO_FAR = "so_far"
"""Folder of tables that an interrupted run left."""


def files(material: ReportData) -> list[tuple[str, str]]:
    """Files of the tables' folder beside the report: text and link."""
    folder, here = material.results / material.choice.tables, material.output.resolve()
    paths = (path for path in sorted(folder.rglob("*")) if path.suffix in DATA and path.resolve() != here)
    paths = (path for path in paths if path.is_file() and SO_FAR not in path.relative_to(folder).parts)
    return [(material.relative(path), link(path, here.parent)) for path in paths]


PACKAGES = (
    *("torch", "warp-lang", "newton", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "cma"),
    *("gsplat", "snakemake", "mlflow"),
)
WHAT = ("scenarios", "methods", "seeds", "results", "tables")
"""Keys that say what the benchmark is, not how it runs."""
DIRTY = "-dirty"
PICTURE_STAGES = ("appearance", "render")
"""Their settings are those of `images` and of perception's lifting."""


def setup(material: ReportData) -> PageSection:
    """Configuration, versions, machines, files."""
    blocks: list[Block] = [_commits(material.runs)] if material.runs else []
    blocks += _settings(material)
    blocks.append(_versions())
    if machines := Counter(f"{run.machine}; {run.device}" for run in material.runs):
        rows = [[Cell(text=name), Cell(text=str(count))] for name, count in sorted(machines.items())]
        blocks.append(Table(caption="Machines of the runs", header=["Machine; device", "Runs"], rows=rows))
    beside = files(material)
    if beside:
        links = Items(items=[Link(text=text, target=target) for text, target in beside])
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


def _settings(material: ReportData) -> list[Block]:
    caption = "Settings that differ from the defaults"
    if material.choice.settings is not None:
        settings, defaults = config.plain(material.choice.settings), flat(config.plain(Config()))
        changed = {key: value for key, value in flat(settings).items() if defaults.get(key) != value and key not in WHAT}
        rows = [[key, _plain(defaults.get(key)), _plain(value)] for key, value in sorted(changed.items())]
        table = Table.of_texts(["Setting", "Default", "Here"], rows, caption)
        text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)
        return [
            table if rows else Text(text="All settings have their defaults."),
            Fold(summary="Full configuration", blocks=[Code(text=text)]),
        ]
    used: dict[str, dict[str, str]] = defaultdict(dict)
    for run in material.runs:
        for name, value in departures(run.settings).items():
            used[name].setdefault(run.method, _plain(value))
    if not used:
        return []
    cells = [[Cell(text=name), Cell(text=_by_method(values), wrap=True)] for name, values in sorted(used.items())]
    text = "Read from the run records, since no configuration was given: what the stages were run with."
    return [Text(text=text, tone="mute"), Table(caption=caption, header=["Setting", "Here"], rows=cells)]


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _by_method(values: Mapping[str, str]) -> str:
    groups: dict[str, list[str]] = defaultdict(list)
    for method, value in values.items():
        groups[value].append(method)
    if len(groups) == 1:
        return next(iter(groups))
    return "; ".join(f"{value} ({', '.join(names)})" for value, names in groups.items())


def _versions() -> Table:
    rows = [[Cell(text="python"), Cell(text=platform.python_version())]]
    for name in PACKAGES:
        try:
            rows.append([Cell(text=name), Cell(text=metadata.version(name))])
        except metadata.PackageNotFoundError:
            continue
    return Table(caption="Versions where this page was written", header=["Package", "Version"], rows=rows)


def departures(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The settings of every stage that differ from the defaults or have no default, under dotted names."""
    defaults = config.plain(config.Config())
    pictures = defaults | defaults["images"] | {"lift": defaults["perception"]["lift"]}
    models = {None: defaults, **defaults["baselines"]}
    different: dict[str, Any] = {}
    for stage, values in settings.items():
        # The settings of a baseline's training are those of the section of its model.
        of_model = models.get(values.get("model"), defaults)
        different |= _different(values, pictures if stage in PICTURE_STAGES else of_model, stage)
    return {name: value for name, value in sorted(different.items()) if not name.endswith(".seed")}


def _different(values: Mapping[str, Any], defaults: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    different: dict[str, Any] = {}
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            different |= _different(value, default, f"{prefix}.{name}")
        elif name not in defaults or value != default:
            different[f"{prefix}.{name}"] = value
    return different


section = ReportSection(order=110, make=setup)
