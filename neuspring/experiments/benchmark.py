"""A benchmark: the configuration with the rows of the three tables that it names, checked together before any job exists."""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from neuspring.baselines import BASELINES, REFERENCES
from neuspring.config import (
    Config,
    Fit,
    Losses,
    Method,
    ReleasedQuirks,
    ScenarioRow,
    Search,
    SearchRow,
    merge,
    parse,
    plain,
    read_yaml,
)
from neuspring.config.images import Appearance
from neuspring.config.rows import RENAMED_ROWS
from neuspring.core.errors import InputError
from neuspring.data.sources import SOURCES, Source, location, read_scenarios
from neuspring.perception.backends import BACKENDS
from neuspring.scores.lpips_weights import configured
from neuspring.scores.studies import Study, read_studies

RESERVED = ("tables", "logs", "benchmarks", "jobs", "tune", "mlartifacts", "published", "appearance", "perception", "capture")
"""Folders of the results that are no scenarios or methods."""
LEAST_TOGETHER = 3
"""Fewer fits gain less from shared launches than from jobs of their own, which run at the same time."""
REMEDY = "Name what to run on, for example --configfile config/data/demo.yaml."


def read_methods(path: Path) -> dict[str, Method]:
    """The method table: name -> Method. Raises InputError."""
    methods = {name: parse(Method, row, f"{path}, method {name}") for name, row in read_yaml(path).items()}
    for name, method in methods.items():
        where = f"{path}, method {name}"
        if method.model and method.model not in BASELINES:
            raise InputError(f"{where}, model", f"must be one of {', '.join(BASELINES)}", method.model)
        if method.settings and method.model and not BASELINES[method.model].trained:
            raise InputError(f"{where}, settings", f"model {method.model} has none", sorted(method.settings))
        if method.appearance is not None and not (method.model and BASELINES[method.model].own_splats):
            owners = ", ".join(name for name, baseline in BASELINES.items() if baseline.own_splats)
            raise InputError(f"{where}, appearance", f"only {owners} draws with splats of its own", method.model)
    return methods


def read_searches(path: Path) -> dict[str, SearchRow]:
    """The search table: name -> SearchRow."""
    return {name: parse(SearchRow, row, f"{path}, search {name}") for name, row in read_yaml(path).items()}


def chosen_part(config: Config, scenarios: Mapping[str, ScenarioRow]) -> Config:
    """The configuration with what `only` leaves of its scenarios, methods and seeds. Raises InputError for terms without match."""
    where = "configuration, only"
    rule = "terms scenario=..., category=..., method=..., seed=..., each with names or patterns separated by commas"
    kept: dict[str, tuple[Any, ...]] = {"scenarios": config.scenarios, "methods": config.methods, "seeds": config.seeds}
    try:
        terms = shlex.split(config.only)
    except ValueError as error:
        raise InputError(where, rule, config.only, f"{error}.") from error
    for term in terms:
        key, _, text = term.partition("=")
        names = {"scenario": "scenarios", "category": "scenarios", "method": "methods", "seed": "seeds"}
        if key not in names or not text:
            raise InputError(where, rule, term)
        for pattern in text.split(","):
            known = [_word(entry, key, scenarios) for entry in kept[names[key]]]
            if not fnmatch.filter(known, pattern):
                raise InputError(where, f"{key} {pattern!r} matches none of the configuration's", ", ".join(dict.fromkeys(known)))
        kept[names[key]] = tuple(
            entry
            for entry in kept[names[key]]
            if any(fnmatch.fnmatchcase(_word(entry, key, scenarios), pattern) for pattern in text.split(","))
        )
    return dataclasses.replace(config, scenarios=kept["scenarios"], methods=kept["methods"], seeds=kept["seeds"])


def _word(entry: Any, key: str, scenarios: Mapping[str, ScenarioRow]) -> str:
    return scenarios[entry].category if key == "category" else str(entry)


def fit_of(config: Config, method: Method, name: str) -> Fit:
    """The fit settings of a method: the configuration's, with the method's own on top. Raises InputError for unknown keys."""
    return parse(Fit, _overlaid(config.fit, method.settings), f"method {name}, settings")


def search_of(config: Config, row: SearchRow, name: str) -> Search:
    """The search settings of a row: the configuration's, with the row's own on top. Raises InputError for unknown keys."""
    return parse(Search, _overlaid(config.search, row.settings), f"search {name}, settings")


def quirks_of(config: Config, row: SearchRow, name: str) -> ReleasedQuirks:
    """The quirks of a search and of the fits that start from it: the row's own on top of the configuration's. Raises InputError."""
    return parse(ReleasedQuirks, _overlaid(config.released_quirks, row.released_quirks), f"search {name}, released_quirks")


def losses_of(config: Config, row: SearchRow, name: str) -> Losses:
    """The losses of a search and of the fits that start from it: the row's own on top of the configuration's. Raises InputError."""
    return parse(Losses, _overlaid(config.losses, row.losses), f"search {name}, losses")


def section_of(config: Config, method: Method, name: str) -> Any:
    """The settings of a trained baseline: its section, with the method's own on top. Raises InputError for unknown keys."""
    assert method.model
    section = getattr(config.baselines, BASELINES[method.model].section)
    return parse(type(section), _overlaid(section, method.settings), f"method {name}, settings")


def appearance_of(config: Config, method: Method, name: str) -> Appearance:
    """How a method's splats are trained: as all, with the method's own settings on top. Raises InputError for unknown keys."""
    return parse(Appearance, _overlaid(config.images.appearance, method.appearance or {}), f"method {name}, appearance")


def _overlaid(settings: Any, own: Mapping[str, Any]) -> dict[str, Any]:
    values = plain(settings)
    merge(values, own)
    return values


@dataclass(frozen=True)
class Benchmark:
    """A validated configuration with the rows it names."""

    config: Config
    """With what `only` leaves of scenarios, methods and seeds."""
    whole: Config
    """As it was given: what tables are laid out for, whatever part of it is run now."""
    scenarios: dict[str, ScenarioRow]
    """Chosen ones, those that twins are transferred to, those of the sweep."""
    whole_scenarios: dict[str, ScenarioRow]
    """Those of the whole configuration."""
    methods: dict[str, Method]
    searches: dict[str, SearchRow]
    fits: dict[str, Method]
    """The methods whose fits are made: of all rows of the table with the same fit, the first."""
    fit_of_method: dict[str, str]
    """Chosen method -> the method in whose folder its fit lies."""
    transfers: dict[str, tuple[str, ...]]
    """Chosen scenario -> those that its twins are transferred to."""
    pictured: frozenset[str]
    """Methods of the whole configuration that are trained on pictures, so that scenarios without any are left out."""
    splats: dict[str, Method]
    """Methods whose own splats are made: of all rows of the table with the same settings, the first."""
    splats_of_method: dict[str, str]
    """Chosen method with splats of its own -> the method in whose name they are made."""
    studies: dict[str, Study]
    """All rows of the study table; `config.studies` names those that are made without being asked for."""
    pools: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    """Scenario of the whole configuration -> the other recordings of its pool, where a method has one."""
    pooled: frozenset[str] = frozenset()
    """Methods of the whole configuration that are judged on a pool, so that scenarios without any are left out."""
    on_gpu: bool = False
    """Whether jobs take GPUs. `twins_per_launch: auto` lets no fits share launches there: nobody has measured whether it pays."""

    @classmethod
    def of(cls, values: Mapping[str, Any], root: Path) -> Benchmark:
        """Check everything that can be checked before a job starts. Tables are read relative to `root`. Raises InputError."""
        whole = parse(Config, values, "configuration")
        scenarios, methods = read_scenarios(root / whole.scenario_table), read_methods(root / whole.method_table)
        studies = read_studies(root / whole.study_table)
        _require_known("studies", whole.studies, studies, whole.study_table)
        _require_known("methods", whole.methods, methods, whole.method_table)
        whole = _with_methods_of_studies(whole, studies, methods)
        for name in ("scenarios", "methods", "seeds"):
            if not getattr(whole, name):
                raise InputError(f"configuration, {name}", "at least one entry is required", None, REMEDY)
        _require_known("scenarios", whole.scenarios, scenarios, whole.scenario_table)
        whole = _with_references(whole, scenarios, methods)
        config = chosen_part(whole, scenarios)
        searches = read_searches(root / config.search_table)
        wanted = tuple(dict.fromkeys(search for n in config.methods if (search := methods[n].search)))
        _require_known("methods' search", wanted, searches, config.search_table)
        _require_known("compare_with", (config.compare_with,) if config.compare_with else (), methods, config.method_table)
        pairs = config.transfers or {}
        everyone = tuple(name for source, names in pairs.items() for name in (source, *names))
        _require_known("transfers", everyone, scenarios, config.scenario_table)
        transfers = {source: names for source, names in pairs.items() if source in config.scenarios}
        targets = tuple(name for names in transfers.values() for name in names)
        pools = _pools(whole, scenarios, methods, searches)
        targets += tuple(other for name in config.scenarios for other in pools.get(name, ()))
        _require_alike(config, scenarios, transfers)
        if whole.tune:
            of = "this configuration's scenarios"
            _require_known("tune.scenarios", whole.tune.scenarios, dict.fromkeys(whole.scenarios + targets), of)
        owners = {name: owner for name, owner in _fit_owners(config, methods).items() if name in config.methods}
        looks = {name: owner for name, owner in _splat_owners(config, methods).items() if name in config.methods}
        chosen = cls(
            config,
            whole,
            {n: scenarios[n] for n in dict.fromkeys(config.scenarios + targets + _tuned(whole))},
            {n: scenarios[n] for n in whole.scenarios},
            {n: methods[n] for n in config.methods},
            {row.searched: searches[row.search] for n in config.methods if (row := methods[n]).search},
            {n: methods[n] for n in owners.values()},
            owners,
            transfers,
            frozenset(name for name in whole.methods if _trained_on_pictures(whole, methods[name], name)),
            {n: methods[n] for n in looks.values()},
            looks,
            studies,
            pools,
            frozenset(name for name in whole.methods if methods[name].pool),
        )
        for name in [*chosen.scenarios, *chosen.methods]:
            if name in (*RESERVED, config.tables) or name.startswith("search-"):
                rule = f"{', '.join(sorted({*RESERVED, config.tables}))} and search-... are folders of the results"
                raise InputError("name of a scenario or method", rule, name, "Rename it.")
        for name, method in chosen.methods.items():
            chosen._check_settings(name, method)
        chosen._require_data()
        chosen._require_applying()
        return chosen

    def _check_settings(self, name: str, method: Method) -> None:
        """Settings of a method's own, before any job starts."""
        if method.model:
            if BASELINES[method.model].trained:
                section = section_of(self.config, method, name)
                if name in self.pictured:
                    # Named weights that are missing or wrong are an error before the first job.
                    BASELINES[method.model].features(section)
            appearance_of(self.config, method, name)
        if method.search:
            quirks_of(self.config, self.searches[method.searched], method.search)
            losses_of(self.config, self.searches[method.searched], method.search)
        if not (method.search and method.fit):
            return
        wanted = search_of(self.config, self.searches[method.searched], method.search).variables.stiffness
        fit = fit_of(self.config, method, name)
        if method.oracle and fit.selection == "tail":
            rule = "an oracle is fitted on all frames and holds none back"
            raise InputError(f"method {name}, fit.selection", rule, "tail", "Use training_loss.")
        low, high = fit.stiffness_range
        if not low <= wanted.low < wanted.high <= high:
            rule = f"must hold the search's range of {wanted.low} to {wanted.high}, or springs start beyond their clamp"
            raise InputError(f"method {name}, fit.stiffness_range", rule, [low, high])

    def pool_kind(self, job: Any) -> str | None:
        """Of the search that a job makes, or of its method: whether it is judged on all of the pool, the others, or no pool."""
        rows = self.fits | self.methods
        if hasattr(job, "method"):
            return rows[job.method].pool
        return next((row.pool for row in rows.values() if row.search and row.searched == job.search), None)

    def fits_together(self, scenario: str) -> tuple[tuple[str, int], ...]:
        """The fits (method, seed) of a scenario that share launches: those in step (horizon, frames), if not too few.

        None where `twins_per_launch` is 1, or auto on a GPU.
        """
        most = self.config.twins_per_launch
        if most == 1 or (most == "auto" and self.on_gpu) or scenario not in self.config.scenarios:
            return ()
        # A fit on several recordings takes turns between them, and shares launches with nobody.
        rows = [name for name, method in self.fits.items() if self.applies(name, scenario) and not method.pool]
        seeds = self.config.seeds
        alike = Counter(self._steps[name] for name in rows)
        return tuple((name, seed) for name in rows if alike[self._steps[name]] * len(seeds) >= LEAST_TOGETHER for seed in seeds)

    @cached_property
    def _steps(self) -> dict[str, tuple[int, bool]]:
        """Of each fit: frames per step, and whether it goes over all frames (an oracle) or over those before the split."""
        return {name: (fit_of(self.config, method, name).horizon, method.oracle) for name, method in self.fits.items()}

    @property
    def tuned(self) -> tuple[str, ...]:
        """The scenarios of the sweep: it keeps them, whatever part of the runs is made now."""
        return _tuned(self.whole)

    @property
    def compared_with(self) -> str:
        """The method that tables compare the others with."""
        wanted = self.whole.compare_with
        return wanted if wanted in self.whole.methods else self.whole.methods[0]  # type: ignore[return-value]

    def methods_of(self, study: str) -> tuple[str, ...]:
        """The chosen methods that stand in a study's rows, and in those of the study beside it."""
        shown = [self.studies[name] for name in (study, self.studies[study].beside) if name]
        return tuple(dict.fromkeys(name for rows in shown for name in rows.rows.values() if name in self.methods))

    def _row(self, name: str) -> ScenarioRow:
        """Of a scenario, whether it is chosen or not."""
        return self.scenarios.get(name) or self.whole_scenarios[name]

    def source(self, name: str) -> Source:
        """The kind of data of a scenario."""
        return SOURCES[self._row(name).source]

    def data_path(self, name: str) -> Path | None:
        """Where a scenario's data lie; None for scenes that are made here."""
        return location(self._row(name), self.config) if self.source(name).needs_data else None

    def has_images(self, name: str) -> bool:
        """Whether a scenario's predictions are drawn and scored."""
        source, path = self.source(name), self.data_path(name)
        return self.config.images.enabled and (source.films or (path is not None and source.images_beside(path)))

    def applies(self, method: str, scenario: str) -> bool:
        """Whether a method can be run on a scenario: what is trained on silhouettes needs images, what has a pool the others."""
        if method in self.pooled and scenario not in self.pools:
            return False
        return method not in self.pictured or self.has_images(scenario)

    @property
    def whole_left_out(self) -> dict[str, tuple[str, ...]]:
        """Of the whole configuration: method -> the scenarios to which it does not apply; methods that apply to all are no keys."""
        some = self.pictured | self.pooled
        without = {n: tuple(s for s in self.whole_scenarios if not self.applies(n, s)) for n in self.whole.methods if n in some}
        return {name: scenarios for name, scenarios in without.items() if scenarios}

    def _require_applying(self) -> None:
        """Raise InputError if nothing of what was asked for can be run."""
        if not any(self.applies(method, scenario) for method in self.methods for scenario in self.config.scenarios):
            rule = "at least one method must apply to a scenario; what is trained on silhouettes needs images, a pool `pools`"
            remedy = "Choose scenarios with images (and images.enabled), name pools, or choose another method."
            raise InputError("configuration, methods", rule, ", ".join(self.methods), remedy)

    def capture_folder(self, name: str) -> Path:
        """Where a scenario's capture lies: the user's folder, or one in the results that the workflow makes."""
        own = None if self.source(name).write_capture else self.data_path(name)
        return own or Path(self.config.results) / name / "capture"

    def cameras(self, name: str) -> tuple[str, ...]:
        """Names of a scenario's cameras, which are known before its capture is made. Raises InputError."""
        return self.source(name).cameras(location(self._row(name), self.config), self.config)

    def _require_data(self) -> None:
        if self.config.images.enabled:
            # Named weights that are missing or wrong are an error before the first job.
            configured(self.config.images.lpips)
        for name, row in self.scenarios.items():
            path = self.data_path(name)
            if path is None:
                continue
            if self.config.data_root is None:
                raise InputError(
                    f"scenario {name}",
                    f"{row.source} scenarios need data_root",
                    "null",
                    "Give it: --config data_root=/path/to/data.",
                )
            if not path.exists():
                raise InputError(f"scenario {name}", "its data must exist", path, "Correct data_root or the scenario table's path.")
            SOURCES[row.source].required(path)
            if SOURCES[row.source].films and not SOURCES[row.source].write_capture:
                BACKENDS["segment"][self.config.perception.segment.backend].require(path)


def _with_methods_of_studies(config: Config, studies: Mapping[str, Study], methods: Mapping[str, Method]) -> Config:
    """The configuration with the methods in the rows of its studies. If they add any, all are in the order of the method table."""
    implied = {method for study in config.studies for method in studies[study].rows.values() if method in methods}
    if implied <= set(config.methods):
        return config
    union = implied | set(config.methods)
    return dataclasses.replace(config, methods=tuple(name for name in methods if name in union))


def _with_references(config: Config, scenarios: Mapping[str, ScenarioRow], methods: Mapping[str, Method]) -> Config:
    """The configuration with the methods that learn nothing first, if it has scenarios that users filmed."""
    if not any(SOURCES[scenarios[name].source].own for name in config.scenarios):
        return config
    beside = tuple(name for name in REFERENCES if name in methods and name not in config.methods)
    return dataclasses.replace(config, methods=beside + config.methods) if beside else config


def _tuned(whole: Config) -> tuple[str, ...]:
    """The scenarios of the sweep; none without one."""
    return whole.tune.scenarios or whole.scenarios if whole.tune else ()


def _fit_owners(config: Config, methods: Mapping[str, Method]) -> dict[str, str]:
    """Method with a fit -> the first row of the table with the same search, stage, frames (all for an oracle) and settings."""
    first: dict[tuple[Any, ...], str] = {}
    fitted = {name: method for name, method in methods.items() if method.fit}
    return {
        name: first.setdefault((m.search, m.pool, m.fit, m.oracle, fit_of(config, m, name)), name) for name, m in fitted.items()
    }


def _pools(
    whole: Config, scenarios: Mapping[str, ScenarioRow], methods: Mapping[str, Method], searches: Mapping[str, SearchRow]
) -> dict[str, tuple[str, ...]]:
    """Scenario -> the others of its pool, of those that are in one; none where no method has a pool. Raises InputError."""
    if not any(methods[name].pool for name in whole.methods):
        return {}
    taken = [name for name in searches if name.endswith(("-all", "-others"))]
    if taken:
        raise InputError(whole.search_table, "names that end with -all or -others belong to searches on a pool", ", ".join(taken))
    members = {name: names for names in (whole.pools or {}).values() for name in names}
    _require_known("pools", tuple(members), scenarios, whole.scenario_table)
    pools = {name: tuple(other for other in names if other != name) for name, names in members.items()}
    _require_alike(whole, scenarios, pools, "pools")
    return pools


def _splat_owners(config: Config, methods: Mapping[str, Method]) -> dict[str, str]:
    """Method with splats of its own -> the first row of the table with the same settings of theirs."""
    first: dict[Any, str] = {}
    own = {name: method for name, method in methods.items() if method.appearance is not None}
    return {name: first.setdefault(appearance_of(config, method, name), name) for name, method in own.items()}


def _trained_on_pictures(config: Config, method: Method, name: str) -> bool:
    baseline = BASELINES.get(method.model or "")
    return bool(baseline and baseline.trained and baseline.takes_pictures(section_of(config, method, name)))


def _require_alike(
    config: Config, scenarios: Mapping[str, ScenarioRow], transfers: Mapping[str, tuple[str, ...]], key: str = "transfers"
) -> None:
    """Twins go to recordings of the same object with as many nodes."""
    for source, target in ((s, t) for s, targets in transfers.items() for t in targets):
        here, there = scenarios[source], scenarios[target]
        if (here.source, here.category) != (there.source, there.category):
            rule = f"{target} must be of the same object as {source}: source {here.source}, category {here.category}"
            raise InputError(f"configuration, {key}", rule, f"source {there.source}, category {there.category}")
        SOURCES[here.source].require_alike(config)


def _with_hint(name: str, known: Mapping[str, Any]) -> str:
    """An unknown row, and what to name in its place: its name now, or one that is spelled alike."""
    if now := RENAMED_ROWS.get(name):
        return f"{name!r} ({now if ' ' in now else f'now {now!r}'})"
    alike = difflib.get_close_matches(name, known, n=1)
    return f"{name!r} (did you mean {alike[0]!r}?)" if alike else f"{name!r}"


def _require_known(key: str, names: tuple[str, ...], known: Mapping[str, Any], table: str) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        hints = [_with_hint(name, known) for name in unknown]
        raise InputError(
            f"configuration, {key}", f"every entry must be a row of {table}", ", ".join(hints), f"Known: {', '.join(known)}"
        )
