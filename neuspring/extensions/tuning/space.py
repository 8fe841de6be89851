"""The space of a sweep: settings of one method and of its search, checked before the first trial.

The baseline is the configuration with the settings of the method's row and of its search row on top. A trial puts its values on top
of that. Nothing heavy is imported: the workflow makes a plan before any job exists.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring import config
from neuspring.config import Config, Method, SearchRow
from neuspring.config.tuning import Dimension, Tune
from neuspring.core.errors import InputError
from neuspring.core.records import canonical
from neuspring.experiments.benchmark import read_methods, read_searches, with_method, with_search
from neuspring.twin.body import BODIES

SECTIONS = ("simulation", "losses", "search", "fit", "released_quirks")
"""Sections that a trial reads; observations are made before."""
CLUSTERS = "clusters"
# The acceleration term guides the search alone; the objective is the loss of a fit.
_WEIGHTS = tuple(f"losses.{term.name}" for term in dataclasses.fields(config.Losses) if term.name != "acceleration")
FIXED = (*_WEIGHTS, "fit.selection", "released_quirks.frozen_loss_denominators")
"""The objective is measured with these, so all trials must share them."""
SWEEP_SEED = 0
"""Seed of search, field and sampler, the same in all trials, so that they differ by their settings alone."""


@dataclass(frozen=True)
class Plan:
    """A sweep with everything that it refers to."""

    tune: Tune
    method: Method
    row: SearchRow
    """The method's search."""
    base: dict[str, Any]
    """`SECTIONS` and `clusters` of the unchanged configuration, as plain values."""

    @classmethod
    def of(cls, settings: Config, tune: Tune, root: Path = Path()) -> Plan:
        """Check a sweep as far as that needs no data. Tables are read relative to `root`. Raises InputError."""
        methods = read_methods(root / settings.method_table)
        searches = read_searches(root / settings.search_table, settings.clusters)
        method = _row("tune.method", tune.method, methods, settings.method_table)
        if method.oracle:
            raise InputError("tune.method", "an oracle sees the future, and chooses nothing", tune.method, "Name another method.")
        row = _row(f"method {tune.method}, search", method.search, searches, settings.search_table)
        if not BODIES[row.body].by_gradients:
            rule = "a sweep watches fits that go epoch by epoch"
            raise InputError("tune.method", rule, f"{tune.method}, a {row.body}", "Name another method.")
        own = with_search(with_method(settings, method, tune.method), row, method.search)
        base = {name: config.plain(getattr(own, name)) for name in SECTIONS} | {CLUSTERS: row.clusters}
        plan = cls(tune, method, row, base)
        for name in tune.space:
            plan._require_setting(name)
        ends = [{name: end} for name, dimension in tune.space.items() for end in _ends(dimension)]
        for values in ({}, *ends):
            plan.at(values, "tune.space, " + ", ".join(f"{name} = {value!r}" for name, value in values.items()))
        return plan

    def at(self, values: Mapping[str, Any], where: str) -> tuple[Config, int]:
        """The settings (`SECTIONS` of a configuration) and number of regions of a trial. Raises InputError."""
        changed = copy.deepcopy(self.base)
        for name, value in values.items():
            *path, key = name.split(".")
            functools.reduce(lambda inside, part: inside[part], path, changed)[key] = value
        clusters = changed.pop(CLUSTERS)
        settings = config.parse(Config, changed, where)
        low, high = settings.fit.stiffness_range
        searched = settings.search.variables.stiffness
        if self.method.fit and not low <= searched.low < searched.high <= high:
            raise InputError(
                f"{where}: fit.stiffness_range",
                f"must hold search.variables.stiffness, {searched.low} to {searched.high}",
                [low, high],
            )
        if not isinstance(clusters, int) or clusters < 1:
            raise InputError(f"{where}: clusters", "must be a whole number, at least 1", clusters)
        return settings, clusters

    @property
    def baseline(self) -> dict[str, Any]:
        """The varied settings as they are in the unchanged configuration."""
        return {name: functools.reduce(lambda inside, part: inside[part], name.split("."), self.base) for name in self.tune.space}

    @property
    def epochs(self) -> int:
        """The most epochs that a trial can have; 1 for a method without first-order stage."""
        dimension = self.tune.space.get("fit.epochs")
        most = self.base["fit"]["epochs"] if dimension is None else max(_ends(dimension), default=0)
        return int(most) if self.method.fit else 1

    def facts(self) -> dict[str, Any]:
        """Facts that must not change while a sweep lasts, as plain values."""
        space = {name: config.plain(dimension) for name, dimension in self.tune.space.items()}
        return {"method": self.tune.method, "fit": self.method.fit, "base": self.base, "space": space, "seed": SWEEP_SEED}

    def is_whole(self, name: str) -> bool:
        """True where a setting takes whole numbers only."""
        value, dimension = self.baseline[name], self.tune.space[name]
        # A word (auto) may stand where a whole number can, null where any number can.
        ends = isinstance(dimension.low, int) and isinstance(dimension.high, int)
        return isinstance(value, int) or (isinstance(value, str) and ends)

    def _require_setting(self, name: str) -> None:
        where, section = f"tune.space, {name}", name.partition(".")[0]
        if name != CLUSTERS and section not in SECTIONS:
            rule = f"must begin with {', '.join(SECTIONS)}, or be {CLUSTERS}"
            raise InputError(where, rule, None, _suggestion(section, SECTIONS))
        inside: Any = self.base
        for part in name.split("."):
            known = inside if isinstance(inside, dict) else {}
            if part not in known:
                raise InputError(where, f"{part} must be a setting", None, _suggestion(part, known))
            inside = known[part]
        if isinstance(inside, dict):
            raise InputError(where, "must be one setting, not a section", list(inside))
        method, dimension = self.tune.method, self.tune.space[name]
        faults = {
            "must be the same in all trials: their losses are measured with it": name in FIXED,
            f"method {method} has no first-order stage that would read it": section == "fit" and self.method.fit is None,
            f"method {method} trains springs and reads no settings of a field": (
                name.startswith("fit.field.") and self.method.fit != "field"
            ),
            "is no number: `choices` are required": isinstance(inside, bool | list) and not dimension.choices,
            "its step must be a whole number": isinstance(dimension.step, float) and self.is_whole(name),
        }
        for rule, broken in faults.items():
            if broken:
                raise InputError(where, rule, inside)


def label(value: Any) -> Any:
    """A setting's value as one plain value: JSON text for lists and mappings."""
    return value if value is None or isinstance(value, bool | int | float | str) else canonical(value)


def labels(values: Mapping[str, Any]) -> dict[str, Any]:
    """Setting -> value as one plain value."""
    return {name: label(value) for name, value in values.items()}


def holds(dimension: Dimension, value: Any) -> bool:
    """True where a dimension can take a value."""
    if dimension.choices:
        return value in dimension.choices
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    assert dimension.low is not None
    assert dimension.high is not None
    steps = 0.0 if dimension.step is None else (value - dimension.low) / dimension.step
    return dimension.low <= value <= dimension.high and math.isclose(steps, round(steps), abs_tol=1e-9)


def _ends(dimension: Dimension) -> list[Any]:
    return list(dimension.choices) or [dimension.low, dimension.high]


def _suggestion(word: str, known: Any) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"Did you mean {close[0]}?" if close else ""


def _row(where: str, name: str, rows: Mapping[str, Any], table: str) -> Any:
    if name not in rows:
        raise InputError(where, f"must be a row of {table}", name, _suggestion(name, rows))
    return rows[name]
