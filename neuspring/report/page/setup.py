"""Settings that differ from the defaults, methods, versions, machines."""

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
from neuspring.core.run_record import flat
from neuspring.report.blocks import Block, Cell, Code, Fold, Items, Link, Section, Table, Text
from neuspring.report.page.prose import files
from neuspring.report.page.sources import Material, Run
from neuspring.report.page.words import listed, several
from neuspring.report.page.work import machines
from neuspring.scores.runs import mixed_settings

PACKAGES = (
    *("torch", "warp-lang", "newton", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "cma"),
    *("gsplat", "snakemake", "mlflow"),
)
WHAT = ("scenarios", "methods", "seeds", "results", "tables")
"""Keys that say what the benchmark is, not how it runs."""
DIRTY = "-dirty"
COMMON = {
    "model": "Model",
    "search": "Search",
    "clusters": "Regions",
    "fit": "Fit",
}
"""Switches of methods, and their headings. The model is shown only where a method has one."""
SECTIONS = ("search", "simulation", "losses", "released_quirks", "fit")
"""Sections of the configuration that the records of search and fit hold."""


def section(material: Material) -> Section:
    """Configuration, versions, machines, files."""
    blocks: list[Block] = [_commits(material.runs)] if material.runs else []
    if warning := mixed_settings(material.collected.runs):
        blocks.append(Text(text=warning, tone="warn"))
    blocks += _settings(material)
    variants = _variants(material.runs)
    if variants is not None:
        blocks.append(variants)
    blocks += [_versions(), *_machines(material.runs)]
    beside = files(material)
    if beside:
        links = Items(items=[Link(text=text, target=target) for text, target in beside])
        blocks.append(Fold(summary=f"{several(len(beside), 'file')} with the tables' data, beside this page", blocks=[links]))
    return Section(key="setup", title="Configuration and versions", blocks=blocks)


def _commits(runs: Iterable[Run]) -> Text:
    """The code that made the runs, with a warning if it was not the same for all."""
    own = Counter(run.record.commit or "unknown" for run in runs)
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


def _settings(material: Material) -> list[Block]:
    defaults = flat(config.plain(Config()))
    if material.settings is not None:
        settings = config.plain(material.settings)
        changed = {key: {"": value} for key, value in flat(settings).items() if defaults.get(key) != value and key not in WHAT}
        text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True, width=120)
        return [
            _changes("Settings that differ from the defaults", changed, defaults),
            Fold(summary="Full configuration", blocks=[Code(text=text)]),
        ]
    used = _used(material.runs)
    if not used:
        return []
    changed = {key: values for key, values in used.items() if any(value != defaults.get(key) for value in values.values())}
    text = "Read from the run records, since no configuration was given: what search, fit and training were run with."
    return [Text(text=text, tone="mute"), _changes("Settings that differ from the defaults", changed, defaults)]


def _used(runs: Iterable[Run]) -> dict[str, dict[str, Any]]:
    """Setting to method to value, from the records of search, fit and baselines' training."""
    used: dict[str, dict[str, Any]] = defaultdict(dict)
    for run in runs:
        for stage in (run.record.settings.get(name, {}) for name in ("search", "fit")):
            sections = {name: stage[name] for name in SECTIONS if isinstance(stage.get(name), Mapping)}
            for key, value in flat(sections).items():
                used[key].setdefault(run.method, value)
        own = {name: value for name, value in run.record.settings.get("train", {}).items() if name not in ("model", "seed")}
        for key, value in flat(own, f"baselines.{run.record.model}.").items():
            used[key].setdefault(run.method, value)
    return dict(used)


def _changes(caption: str, changed: Mapping[str, Mapping[str, Any]], defaults: Mapping[str, Any]) -> Block:
    if not changed:
        return Text(text="All settings have their defaults.")
    rows = [
        [Cell(text=key), Cell(text=_plain(defaults.get(key))), Cell(text=_by_method(values), wrap=True)]
        for key, values in sorted(changed.items())
    ]
    return Table(caption=caption, header=["Setting", "Default", "Here"], rows=rows)


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _by_method(values: Mapping[str, Any]) -> str:
    groups: dict[str, list[str]] = defaultdict(list)
    for method, value in values.items():
        groups[_plain(value)].append(method)
    if len(groups) == 1:
        return next(iter(groups))
    return "; ".join(f"{value} ({', '.join(names)})" for value, names in groups.items())


def _variants(runs: Iterable[Run]) -> Table | None:
    """The switches of each method, as its runs record them."""
    variants: dict[str, Mapping[str, Any]] = {}
    for run in runs:
        variants.setdefault(run.method, run.record.variant)
    if not variants:
        return None
    common = {name: text for name, text in COMMON.items() if name != "model" or any("model" in own for own in variants.values())}
    rows = []
    for method, variant in variants.items():
        own = ", ".join(f"{key}: {_plain(value)}" for key, value in variant.items() if key not in common)
        cells = [Cell(text=_word(variant.get(name))) for name in common]
        rows.append([Cell(text=method), *cells, Cell(text=own, wrap=True)])
    header = ["Method", *common.values(), "Settings of its own"]
    return Table(caption="Methods", header=header, rows=rows)


def _word(value: Any) -> str:
    return {None: "–", True: "yes", False: "no"}[value] if value is None or isinstance(value, bool) else str(value)


def _versions() -> Table:
    rows = [[Cell(text="python"), Cell(text=platform.python_version())]]
    for name in PACKAGES:
        try:
            rows.append([Cell(text=name), Cell(text=metadata.version(name))])
        except metadata.PackageNotFoundError:
            continue
    return Table(caption="Versions where this page was written", header=["Package", "Version"], rows=rows)


def _machines(runs: Iterable[Run]) -> list[Block]:
    counts = machines(runs)
    rows = [[Cell(text=name), Cell(text=str(count))] for name, count in counts.items()]
    return [] if not rows else [Table(caption="Machines of the runs", header=["Machine; device", "Runs"], rows=rows)]
