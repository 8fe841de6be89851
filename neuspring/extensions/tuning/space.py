"""The space of a sweep: settings of one method and of its search, checked before the first trial.

A trial overrides settings of the configuration, after those of the method and its search. This module imports nothing heavy,
because the workflow makes a plan before any job exists.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring import config
from neuspring.config import Config, Method, SearchRow
from neuspring.config.tuning import Dimension, Tune
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import read_methods, read_searches, with_method, with_search
from neuspring.twin.body import BODIES

SECTIONS = ("simulation", "losses", "search", "fit", "released_quirks")
"""Sections that a sweep can vary; observations are made before."""
SWEEP_SEED = 0
"""Seed of search and field. All trials share it, so that they differ only in their settings."""


@dataclass(frozen=True)
class Plan:
    """A sweep with its method, search and settings."""

    tune: Tune
    method: Method
    row: SearchRow
    """The method's search."""
    base: dict[str, Any]
    """`SECTIONS` and `clusters` of the unchanged configuration, as plain values."""

    @classmethod
    def of(cls, settings: Config, tune: Tune, root: Path = Path()) -> Plan:
        """Check a sweep without its data. Tables are read relative to `root`. Raises InputError."""
        extra = [root / path for path in settings.extra_rows.values()]
        methods = read_methods(root / settings.method_table, extra)
        searches = read_searches(root / settings.search_table, settings.clusters, extra)
        method = methods.get(tune.method)
        row = searches.get(method.search) if method and method.search else None
        if method is None or row is None or method.oracle or not BODIES[row.body].by_gradients:
            rule = f"must be a method of {settings.method_table} with a search and a gradient fit, and not an oracle"
            raise InputError("tune.method", rule, tune.method)
        unchanged = with_search(with_method(settings, method, tune.method), row, method.search or "")
        base = {name: config.plain(getattr(unchanged, name)) for name in SECTIONS} | {"clusters": row.clusters}
        plan = cls(tune, method, row, base)
        for name, dimension in tune.space.items():
            if (section := name.partition(".")[0]) not in (*SECTIONS, "clusters"):
                raise InputError(f"tune.space, {name}", f"must begin with {', '.join(SECTIONS)}, or be clusters", section)
            for end in dimension.choices or (dimension.low, dimension.high):
                plan.at({name: end}, f"tune.space, {name} = {end!r}")
            plan._require_variable(name, dimension)
        return plan

    def at(self, values: Mapping[str, Any], where: str) -> tuple[Config, int]:
        """The settings (`SECTIONS` of a configuration) and the number of regions of a trial. Raises InputError."""
        changed = copy.deepcopy(self.base)
        for name, value in values.items():
            section, key = section_of(changed, name)
            if not isinstance(section, dict) or isinstance(section.get(key), dict):
                raise InputError(where, "must be one setting, not a section or an item of a setting")
            section[key] = value
        clusters = changed.pop("clusters")
        settings = config.parse(Config, changed, where)
        low, high = settings.fit.stiffness_range
        searched = settings.search.variables.stiffness
        if self.method.fit and not low <= searched.low < searched.high <= high:
            rule = f"fit.stiffness_range must contain search.variables.stiffness, {searched.low} to {searched.high}"
            raise InputError(where, rule, [low, high])
        if not isinstance(clusters, int) or clusters < 1:
            raise InputError(where, "clusters must be an integer, at least 1", clusters)
        return settings, clusters

    @property
    def baseline(self) -> dict[str, Any]:
        """The values of the varied settings in the unchanged configuration."""
        return {name: functools.reduce(lambda inside, part: inside[part], name.split("."), self.base) for name in self.tune.space}

    def facts(self) -> dict[str, Any]:
        """Facts that must not change during a sweep, as plain values."""
        space = {name: config.plain(dimension) for name, dimension in self.tune.space.items()}
        return {"method": self.tune.method, "fit": self.method.fit, "base": self.base, "space": space, "seed": SWEEP_SEED}

    def _require_variable(self, name: str, dimension: Dimension) -> None:
        weights = [f"losses.{term.name}" for term in dataclasses.fields(config.Losses) if term.name != "acceleration"]
        fit, value, choices = self.method.fit, self.baseline[name], dimension.choices
        faults = {
            # The weight of acceleration affects only the search; the objective of a trial is the loss of a fit.
            "must be the same in all trials, because it defines their objective": name
            in (*weights, "fit.selection", "released_quirks.frozen_loss_denominators"),
            f"must be a setting that method {self.tune.method} reads": (name.startswith("fit.") and not fit)
            or (name.startswith("fit.field.") and fit != "field"),
            "choices must be numbers, words, true, false or null": any(isinstance(choice, list | dict) for choice in choices),
            f"its values must include that of the method, {value}": not contains(dimension, value),
        }
        for rule, broken in faults.items():
            if broken:
                raise InputError(f"tune.space, {name}", rule)


def section_of(sections: dict[str, Any], name: str) -> tuple[Any, str]:
    """The section of a dotted name, which is added if it is missing, and the name of the setting in it."""
    *path, key = name.split(".")
    return functools.reduce(lambda inside, part: inside.setdefault(part, {}), path, sections), key


def contains(dimension: Dimension, value: Any) -> bool:
    """Whether a dimension contains a value; steps do not matter."""
    if dimension.choices or isinstance(value, bool) or not isinstance(value, int | float):
        return value in dimension.choices
    assert dimension.low is not None
    assert dimension.high is not None
    return dimension.low <= value <= dimension.high
