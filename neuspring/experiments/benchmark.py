"""A benchmark: the configuration with the rows of the three tables that it names, checked together before any job exists."""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from neuspring.baselines import BASELINES, REFERENCES
from neuspring.config import Config, Method, ScenarioRow, SearchRow, merge, parse, plain, read_yaml
from neuspring.config.rows import RENAMED_ROWS
from neuspring.core.errors import InputError
from neuspring.core.text import listed
from neuspring.perception.backends import BACKENDS, require_known
from neuspring.scenes.sources import SOURCES, Source, location, scenario_rows, with_deform
from neuspring.scores.lpips import configured_weights
from neuspring.scores.paper import Study, read_studies

T = TypeVar("T")
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
    kept: dict[str, Any] = {"scenarios": config.scenarios, "methods": config.methods, "seeds": config.seeds}
    try:
        terms = shlex.split(config.only)
    except ValueError as error:
        raise InputError(where, rule, config.only, f"{error}.") from error
    for term in terms:
        key, _, text = term.partition("=")
        names = {"scenario": "scenarios", "category": "scenarios", "method": "methods", "seed": "seeds"}
        if key not in names or not text:
            raise InputError(where, rule, term)
        words = {each: scenarios[each].category if key == "category" else str(each) for each in kept[names[key]]}
        patterns = text.split(",")
        for pattern in patterns:
            if not fnmatch.filter(words.values(), pattern):
                known = listed(dict.fromkeys(words.values()))
                raise InputError(where, f"{key} {pattern!r} matches none of the configuration's", known)
        kept[names[key]] = tuple(each for each, word in words.items() if any(fnmatch.fnmatchcase(word, one) for one in patterns))
    return dataclasses.replace(config, **kept)


def for_targets(values: Mapping[str, Any], targets: Collection[str], root: Path) -> dict[str, Any]:
    """What targets that are studies change in a configuration: `studies`; where all are, `only` with the methods of their rows.

    So a table of the paper is made of its rows and no others, whatever methods the configuration names. Raises InputError.
    """
    tables = [values.get(key, getattr(Config, key)) for key in ("study_table", "method_table")]
    listed = values.get("studies") or []
    # What is of another type is refused where settings are read.
    if not targets or not isinstance(listed, list) or not all(isinstance(table, str) for table in tables):
        return {}
    studies = read_studies(root / tables[0])
    asked = [name for name in studies if name in targets]
    if not asked:
        return {}
    changes: dict[str, Any] = {"studies": [*listed, *(name for name in asked if name not in listed)]}
    if len(asked) == len(targets):
        known = read_methods(root / tables[1])
        shown = [name for study in asked for name in rows_of(studies, study) if name in known]
        changes["only"] = f"method={','.join(dict.fromkeys(shown))} {values.get('only') or ''}".strip()
    return changes


def rows_of(studies: Mapping[str, Study], name: str) -> tuple[str, ...]:
    """The methods in the rows of a study, and in those of the study beside it."""
    shown = [studies[each] for each in (name, studies[name].beside) if each]
    return tuple(dict.fromkeys(method for study in shown for method in study.rows.values()))


def overlaid(settings: T, own: Mapping[str, Any], where: str) -> T:
    """A section of the settings with a row's own on top. Raises InputError for unknown keys."""
    values = plain(settings)
    merge(values, own)
    return parse(type(settings), values, where)


def with_search(config: Config, row: SearchRow, name: str) -> Config:
    """The configuration of a search: with the row's settings and quirks on top; those hold for its fits too."""
    own = {"search": row.settings, "released_quirks": row.released_quirks}
    keys = {section: "settings" if section == "search" else section for section in own}
    return dataclasses.replace(
        config, **{key: overlaid(getattr(config, key), own[key], f"search {name}, {keys[key]}") for key in own}
    )


def with_method(config: Config, method: Method, name: str) -> Config:
    """The configuration of a method: its settings on top of `fit`, or of its model's section; how its own splats are trained."""
    where = f"method {name}, settings"
    if method.search:
        config = dataclasses.replace(config, fit=overlaid(config.fit, method.settings, where))
    elif method.model and BASELINES[method.model].trained:
        section = BASELINES[method.model].section
        own = overlaid(getattr(config.baselines, section), method.settings, where)
        config = dataclasses.replace(config, baselines=dataclasses.replace(config.baselines, **{section: own}))
    if method.appearance:
        looks = overlaid(config.images.appearance, method.appearance, f"method {name}, appearance")
        config = dataclasses.replace(config, images=dataclasses.replace(config.images, appearance=looks))
    return config


def section_of(config: Config, method: Method) -> Any:
    """The settings of a trained baseline, in the configuration of its method."""
    return getattr(config.baselines, BASELINES[method.model or ""].section)


class Benchmark:
    """A configuration with the rows that it names, after everything that can be checked before a job starts.

    Tables are read relative to `root`. Raises InputError.
    """

    def __init__(self, values: Mapping[str, Any], root: Path) -> None:
        self.root, whole = root, with_deform(parse(Config, values, "configuration"))
        scenarios, methods = scenario_rows(whole, root), read_methods(root / whole.method_table)
        self.studies = read_studies(root / whole.study_table)
        """All rows of the study table; `config.studies` names those that are made without being asked for."""
        _require_known("studies", whole.studies, self.studies, whole.study_table)
        _require_known("methods", whole.methods, methods, whole.method_table)
        # The methods in the rows of its studies come too. If they add any, all are in the order of the method table.
        implied = {method for study in whole.studies for method in rows_of(self.studies, study) if method in methods}
        if not implied <= set(whole.methods):
            union = implied | set(whole.methods)
            whole = dataclasses.replace(whole, methods=tuple(name for name in methods if name in union))
        for name in ("scenarios", "methods", "seeds"):
            if not getattr(whole, name):
                raise InputError(f"configuration, {name}", "at least one entry is required", None, REMEDY)
        _require_known("scenarios", whole.scenarios, scenarios, f"{whole.scenario_table}, or a capture or recording in data_root")
        self.whole = whole = with_references(whole, scenarios, methods)
        """The configuration as it was given: what tables are laid out for, whatever part of it is run now."""
        self.config = config = chosen_part(whole, scenarios)
        """With what `only` leaves of scenarios, methods and seeds."""
        searches = read_searches(root / config.search_table)
        wanted = tuple(dict.fromkeys(search for n in config.methods if (search := methods[n].search)))
        _require_known("methods' search", wanted, searches, config.search_table)
        _require_known("compare_with", (config.compare_with,) if config.compare_with else (), methods, config.method_table)
        pairs = config.transfers or {}
        everyone = tuple(name for source, names in pairs.items() for name in (source, *names))
        _require_known("transfers", everyone, scenarios, config.scenario_table)
        self.transfers = {source: names for source, names in pairs.items() if source in config.scenarios}
        """Chosen scenario -> those that its twins are transferred to."""
        _require_alike(config, scenarios, self.transfers)
        self.pools = _pools(whole, scenarios, methods, searches)
        """Scenario of the whole configuration -> the other recordings of its pool, where a method has one."""
        targets = tuple(name for names in self.transfers.values() for name in names)
        targets += tuple(other for name in config.scenarios for other in self.pools.get(name, ()))
        self.tuned = whole.tune.scenarios or whole.scenarios if whole.tune else ()
        """The scenarios of the sweep: it keeps them, whatever part of the runs is made now."""
        if whole.tune:
            of = "this configuration's scenarios"
            _require_known("tune.scenarios", whole.tune.scenarios, dict.fromkeys(whole.scenarios + targets), of)
        self.scenarios = {n: scenarios[n] for n in dict.fromkeys(config.scenarios + targets + self.tuned)}
        """Chosen ones, those that twins are transferred to, those of the sweep."""
        self.whole_scenarios = {n: scenarios[n] for n in whole.scenarios}
        """Those of the whole configuration."""
        self.methods = {n: methods[n] for n in config.methods}
        self.searches = {row.searched: searches[row.search] for row in self.methods.values() if row.search}
        fitted = {n: m for n, m in methods.items() if m.fit}
        own = {n: (m.search, m.pool, m.fit, m.oracle, with_method(config, m, n).fit) for n, m in fitted.items()}
        self.fit_of_method = _owners(own, config.methods)
        """Chosen method -> the method in whose folder its fit lies: the first row of the table with the same fit."""
        looks = {n: with_method(config, m, n).images.appearance for n, m in methods.items() if m.appearance is not None}
        self.splats_of_method = _owners(looks, config.methods)
        """Chosen method with splats of its own -> the first row of the table with the same settings of theirs."""
        self.fits = {n: methods[n] for n in self.fit_of_method.values()}
        self.splats = {n: methods[n] for n in self.splats_of_method.values()}
        self.pictured = frozenset(name for name in whole.methods if _trained_on_pictures(whole, methods[name], name))
        """Methods of the whole configuration that are trained on pictures, so that scenarios without any are left out."""
        self.pooled = frozenset(name for name in whole.methods if methods[name].pool)
        """Methods of the whole configuration that are judged on a pool, so that scenarios without any are left out."""
        self.on_gpu = False
        """Whether jobs take GPUs."""
        for name in [*self.scenarios, *self.methods]:
            if name in (*RESERVED, config.tables) or name.startswith("search-"):
                rule = f"{', '.join(sorted({*RESERVED, config.tables}))} and search-... are folders of the results"
                raise InputError("name of a scenario or method", rule, name, "Rename it.")
        for name, method in self.methods.items():
            self._check_settings(name, method)
        self._require_data()
        if not any(self.applies(method, scenario) for method in self.methods for scenario in config.scenarios):
            rule = "at least one method must apply to a scenario; what is trained on silhouettes needs images, a pool `pools`"
            remedy = "Choose scenarios with images (and images.enabled), name pools, or choose another method."
            raise InputError("configuration, methods", rule, ", ".join(self.methods), remedy)

    def _check_settings(self, name: str, method: Method) -> None:
        """Settings of a method's own, before any job starts."""
        config = with_method(self.config, method, name)
        if name in self.pictured:
            # Named weights that are missing or wrong are an error before the first job.
            BASELINES[method.model or ""].features(section_of(config, method))
        if not method.search:
            return
        row = self.searches[method.searched]
        wanted = with_search(self.config, row, method.search).search.variables.stiffness
        if not method.fit:
            return
        if (method.fit == "rod") != (row.body == "rod"):
            rule = f"search {method.search} makes a {row.body}; a rod is fitted as rod, a lattice as springs or field"
            raise InputError(f"method {name}, fit", rule, method.fit)
        if method.oracle and config.fit.selection == "tail":
            rule = "an oracle is fitted on all frames and holds none back"
            raise InputError(f"method {name}, fit.selection", rule, "tail", "Use training_loss.")
        low, high = config.fit.stiffness_range
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

        None where `twins_per_launch` is 1.
        """
        if self.config.twins_per_launch == 1 or scenario not in self.config.scenarios:
            return ()
        # A fit on several recordings takes turns between them, and shares launches with nobody; a rod has lanes of its own.
        alone = [name for name, method in self.fits.items() if method.pool or method.fit == "rod"]
        rows = [name for name in self.fits if self.applies(name, scenario) and name not in alone]
        seeds = self.config.seeds
        alike = Counter(self._steps[name] for name in rows)
        return tuple((name, seed) for name in rows if alike[self._steps[name]] * len(seeds) >= LEAST_TOGETHER for seed in seeds)

    @cached_property
    def _steps(self) -> dict[str, tuple[int, bool]]:
        """Of each fit: frames per step, and whether it goes over all frames (an oracle) or over those before the split."""
        return {name: (with_method(self.config, m, name).fit.horizon, m.oracle) for name, m in self.fits.items()}

    @property
    def compared_with(self) -> str:
        """The method that tables compare the others with."""
        wanted = self.whole.compare_with
        return wanted if wanted in self.whole.methods else self.whole.methods[0]  # type: ignore[return-value]

    def methods_of(self, study: str) -> tuple[str, ...]:
        """The chosen methods that stand in a study's rows, and in those of the study beside it."""
        return tuple(name for name in rows_of(self.studies, study) if name in self.methods)

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

    def capture_folder(self, name: str) -> Path:
        """Where a scenario's capture lies: the user's folder, or one in the results that the workflow makes."""
        own = None if self.source(name).write_capture else self.data_path(name)
        return own or Path(self.config.results) / name / "capture"

    def cameras(self, name: str) -> tuple[str, ...]:
        """Names of a scenario's cameras, which are known before its capture is made. Raises InputError."""
        return self.source(name).cameras(location(self._row(name), self.config), self.config)

    def _require_data(self) -> None:
        require_known(self.config.perception)
        if self.config.images.enabled:
            # Named weights that are missing or wrong are an error before the first job.
            configured_weights(self.config.images.lpips)
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
                raise InputError(
                    f"scenario {name}", "its data must exist", path, "Correct data_root, or the scenario's name or path."
                )
            SOURCES[row.source].required(path)
            if SOURCES[row.source].films and not SOURCES[row.source].write_capture:
                BACKENDS["segment"][self.config.perception.segment.backend].require(path)


def with_references(config: Config, scenarios: Mapping[str, ScenarioRow], methods: Mapping[str, Method]) -> Config:
    """The configuration with the methods that learn nothing first, if it has scenarios that users filmed."""
    if not any(SOURCES[scenarios[name].source].own for name in config.scenarios):
        return config
    beside = tuple(name for name in REFERENCES if name in methods and name not in config.methods)
    return dataclasses.replace(config, methods=beside + config.methods) if beside else config


def _owners(keys: Mapping[str, Any], chosen: Sequence[str]) -> dict[str, str]:
    """Chosen row -> the first row of the table with the same key."""
    first: dict[Any, str] = {}
    owners = {name: first.setdefault(key, name) for name, key in keys.items()}
    return {name: owner for name, owner in owners.items() if name in chosen}


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


def _trained_on_pictures(config: Config, method: Method, name: str) -> bool:
    baseline = BASELINES.get(method.model or "")
    return bool(baseline and baseline.trained and baseline.takes_pictures(section_of(with_method(config, method, name), method)))


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


def _require_known(key: str, names: tuple[str, ...], known: Mapping[str, Any], table: str) -> None:
    """Raise InputError for unknown rows, with what to name in their place: their name now, or one that is spelled alike."""
    hints = []
    for name in names:
        if name in known:
            continue
        if now := RENAMED_ROWS.get(name):
            hints.append(f"{name!r} ({now if ' ' in now else f'now {now!r}'})")
        else:
            alike = difflib.get_close_matches(name, known, n=1)
            hints.append(f"{name!r} (did you mean {alike[0]!r}?)" if alike else f"{name!r}")
    if hints:
        raise InputError(
            f"configuration, {key}", f"every entry must be a row of {table}", ", ".join(hints), f"Known: {listed(known)}"
        )
