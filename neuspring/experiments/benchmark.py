"""A benchmark: the configuration and its table rows, checked together before any job exists.

`Benchmark` contains the rows and decides which method applies to which scenario. `with_search` and `with_method` override the
configuration with the settings of a row. `neuspring.experiments.graph` derives the jobs.
"""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import shlex
import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from neuspring.baselines import BASELINES, REFERENCES
from neuspring.config import Config, Method, ScenarioRow, SearchRow, merge, parse, plain
from neuspring.config.parse import read_rows
from neuspring.core.errors import InputError
from neuspring.core.run_record import flat
from neuspring.core.text import listed
from neuspring.perception.backends import BACKENDS, require_known
from neuspring.scenes.sources import SOURCES, Source, location, scenario_rows
from neuspring.scores.metrics import require_metrics
from neuspring.scores.paper import Study, read_studies
from neuspring.twin.body import BODIES

T = TypeVar("T")
RESERVED = ("tables", "logs", "benchmarks", "jobs", "tune", "mlartifacts", "published", "appearance", "perception", "capture")
"""Folders of the results that are not scenarios or methods."""
NAME_DATA = "Select data, for example --configfile config/data/demo.yaml."


def read_methods(path: Path, extra: Iterable[Path] = ()) -> dict[str, Method]:
    """Read the method table with extra rows: name -> Method, without models of removed extensions. Raises InputError."""
    methods = read_rows(Method, path, "method", extra)
    methods = {name: method for name, method in methods.items() if method.model not in BASELINES.left_out}
    fits = [kind for body in BODIES.values() for kind in body.fits]
    for name, method in methods.items():
        where = f"{path}, method {name}"
        if method.fit and method.fit not in fits:
            raise InputError(f"{where}, fit", f"must be one of {', '.join(fits)}", repr(method.fit))
        if method.model and method.model not in BASELINES:
            raise InputError(f"{where}, model", f"must be one of {', '.join(BASELINES)}", method.model)
        if method.mean_of and (method.mean_of not in methods or methods[method.mean_of].mean_of):
            raise InputError(f"{where}, mean_of", "must be another method without mean_of", method.mean_of)
        if method.settings and method.model and not BASELINES[method.model].section:
            raise InputError(f"{where}, settings", f"model {method.model} has no settings", sorted(method.settings))
        if method.appearance is not None and not (method.model and BASELINES[method.model].own_splats):
            owners = ", ".join(name for name, baseline in BASELINES.items() if baseline.own_splats)
            raise InputError(f"{where}, appearance", f"only models with their own splats ({owners}) have it", method.model)
    return methods


def read_searches(path: Path, clusters: int, extra: Iterable[Path] = ()) -> dict[str, SearchRow]:
    """Read the search table with extra rows: name -> SearchRow; `clusters` is the default number of regions.

    Raises InputError.
    """
    rows = read_rows(SearchRow, path, "search", extra)
    for name, row in rows.items():
        if row.body not in BODIES:
            raise InputError(f"{path}, search {name}, body", f"must be one of {', '.join(BODIES)}", repr(row.body))
    return {name: dataclasses.replace(row, clusters=row.clusters or clusters) for name, row in rows.items()}


def shared_searches(methods: Mapping[str, Method], searches: Mapping[str, SearchRow]) -> dict[str, Method]:
    """The methods, where equal searches are replaced by the first of them, so that methods share it."""
    first: dict[Any, str] = {}
    same = {name: first.setdefault(repr(dataclasses.replace(row, description="")), name) for name, row in searches.items()}
    return {n: dataclasses.replace(m, search=same.get(m.search, m.search)) if m.search else m for n, m in methods.items()}


def chosen_part(config: Config, scenarios: Mapping[str, ScenarioRow]) -> Config:
    """The configuration with the scenarios, methods and seeds that `only` selects. Raises InputError for terms without match."""
    where = "configuration, only"
    rule = "must consist of terms scenario=, category=, method=, seed= with names or patterns separated by commas"
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
        words = {entry: scenarios[entry].category if key == "category" else str(entry) for entry in kept[names[key]]}
        patterns = text.split(",")
        for pattern in patterns:
            if not fnmatch.filter(words.values(), pattern):
                known = listed(dict.fromkeys(words.values()))
                raise InputError(where, f"{key} must match one of {known}", repr(pattern))
        kept[names[key]] = tuple(entry for entry, word in words.items() if any(fnmatch.fnmatchcase(word, p) for p in patterns))
    return dataclasses.replace(config, **kept)


def for_targets(values: Mapping[str, Any], targets: Collection[str], root: Path) -> dict[str, Any]:
    """Changes of a configuration for targets that are studies: `studies`, and, if all targets are studies, `only`.

    `only` selects the methods of these studies, so a table of the paper runs no other methods. Raises InputError.
    """
    if not targets:
        return {}
    given = parse(Config, values, "configuration")
    extra = [root / path for path in given.extra_rows.values()]
    studies = read_studies(root / given.study_table, extra)
    asked = [name for name in studies if name in targets]
    if not asked:
        return {}
    changes: dict[str, Any] = {"studies": list(dict.fromkeys([*given.studies, *asked]))}
    if len(asked) == len(targets):
        known = read_methods(root / given.method_table, extra)
        shown = [name for study in asked for name in rows_of(studies, study) if name in known]
        changes["only"] = f"method={','.join(dict.fromkeys(shown))} {given.only}".strip()
    return changes


def rows_of(studies: Mapping[str, Study], name: str) -> tuple[str, ...]:
    """The methods of a study."""
    return tuple(dict.fromkeys(studies[name].rows.values()))


def overlaid(settings: T, own: Mapping[str, Any], where: str) -> T:
    """A section of the settings, overridden by a row's own settings. Raises InputError for unknown keys."""
    values = plain(settings)
    merge(values, own)
    return parse(type(settings), values, where)


def with_search(config: Config, row: SearchRow, name: str) -> Config:
    """The configuration of a search and its fits: overridden by the row's settings and quirks."""
    search = overlaid(config.search, row.settings, f"search {name}, settings")
    quirks = overlaid(config.released_quirks, row.released_quirks, f"search {name}, released_quirks")
    return dataclasses.replace(config, search=search, released_quirks=quirks)


def with_method(config: Config, method: Method, name: str) -> Config:
    """The configuration of a method: its settings override `fit` or its model's section; `appearance` overrides its splats."""
    where = f"method {name}, settings"
    if method.search:
        config = dataclasses.replace(config, fit=overlaid(config.fit, method.settings, where))
    elif method.model and (section := BASELINES[method.model].section):
        own = overlaid(getattr(config.baselines, section), method.settings, where)
        config = dataclasses.replace(config, baselines=dataclasses.replace(config.baselines, **{section: own}))
    if method.appearance:
        looks = overlaid(config.images.appearance, method.appearance, f"method {name}, appearance")
        config = dataclasses.replace(config, images=dataclasses.replace(config.images, appearance=looks))
    return config


def checked(values: Mapping[str, Any], root: Path, *, plan_only: bool = False) -> Benchmark:
    """The benchmark of a configuration, after all checks that need no job. Raises InputError.

    `plan_only`: missing data are not an error.
    """
    benchmark = Benchmark(values, root, plan_only=plan_only)
    results = Path(benchmark.config.results)
    try:
        results.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=results).close()
    except OSError as error:
        where, rule = f"configuration, results ({results})", "this folder must be writable"
        raise InputError(where, rule, error.strerror, "Choose another folder: --config results=...") from error
    if (results / "jobs" / ".run").exists():
        rule, remedy = "must contain results of this version's workflow", "Use another folder: --config results=..."
        raise InputError(results, rule, "results of an older version", remedy)
    return benchmark


class Benchmark:
    """A configuration with its table rows, after all checks that need no job.

    Table paths are relative to `root`. Raises InputError. With `plan_only`, missing data are stored in `absent` instead.
    """

    def __init__(self, values: Mapping[str, Any], root: Path, *, plan_only: bool = False) -> None:
        self.root, self.on_gpu = root, False
        """`on_gpu`: True if jobs use GPUs; `job.with_gpus` sets it."""
        self.gpu_slots = 0
        """Number of jobs that may hold a GPU at the same time; 0: a cluster decides. `job.with_gpus` sets it."""
        given = parse(Config, values, "configuration").expanded()
        rows = scenario_rows(given, root)
        self.extra = [root / path for path in given.extra_rows.values()]
        """Files with extra rows of the tables."""
        searches = read_searches(root / given.search_table, given.clusters, self.extra)
        self.table = shared_searches(read_methods(root / given.method_table, self.extra), searches)
        self.studies = read_studies(root / given.study_table, self.extra)
        """`table` and `studies`: all methods and studies; `config` contains the names of those that run by default."""
        self.whole = self._whole(given, rows)
        """The configuration without `only`, which defines the layout of tables."""
        self.config = config = chosen_part(self.whole, rows)
        """The configuration with the scenarios, methods and seeds that `only` selects."""
        averaged = (self.table[name].mean_of for name in config.methods)
        self.methods = {name: self.table[name] for name in dict.fromkeys([*config.methods, *filter(None, averaged)])}
        """The selected methods, and the methods that they average."""
        self.searches = self._searches(searches)
        """Name of a search, including its pool -> its row."""
        self.pools, self.transfers = self._groups(rows)
        """`pools`: scenario of the complete configuration -> the other recordings of its pool, if a method uses pools.
        `transfers`: selected scenario -> recordings to which its models are transferred."""
        self.tuned = self.whole.scenarios if self.whole.tune else ()
        """The scenarios of the sweep, independent of `only`."""
        others = [name for names in self.transfers.values() for name in names]
        others += [other for name in config.scenarios for other in self.pools.get(name, ())]
        self.scenarios = {name: rows[name] for name in dict.fromkeys([*config.scenarios, *others, *self.tuned])}
        """The selected scenarios, their transfer targets and pools, and the scenarios of the sweep."""
        self.whole_scenarios = {name: rows[name] for name in self.whole.scenarios}
        """The scenarios of the complete configuration."""
        self.pictured = frozenset(
            name
            for name in self.whole.methods
            if (model := self.table[name].model) and BASELINES[model].pictured(with_method(self.whole, self.table[name], name))
        )
        """Methods of the complete configuration that are trained on images."""
        self.absent: InputError | None = None
        """The error for all missing or invalid data."""
        self._check(plan_only)
        self._check_effect(flat(values.get("fit") or {}))

    # --- rows of the configuration

    def _whole(self, given: Config, rows: Mapping[str, ScenarioRow]) -> Config:
        """The configuration with the methods that its studies and its data add."""
        _require_known("studies", given.studies, self.studies, given.study_table)
        _require_known("methods", given.methods, self.table, given.method_table)
        # Studies add their methods, and a mean adds the method that it averages. Then all methods have the order of the table.
        implied = {averaged for name in given.methods if (averaged := self.table[name].mean_of)}
        implied |= {method for study in given.studies for method in rows_of(self.studies, study) if method in self.table}
        if not implied <= set(given.methods):
            union = implied | set(given.methods)
            given = dataclasses.replace(given, methods=tuple(name for name in self.table if name in union))
        for name in ("scenarios", "methods", "seeds"):
            if not getattr(given, name):
                raise InputError(f"configuration, {name}", "at least one entry is required", None, NAME_DATA)
        _require_known("scenarios", given.scenarios, rows, f"{given.scenario_table}, or a capture or recording in data_root")
        compared = (given.compare_with,) if given.compare_with else ()
        _require_known("compare_with", compared, self.table, given.method_table)
        require_metrics(given.aims)
        return with_references(given, rows, self.table)

    def _searches(self, rows: Mapping[str, SearchRow]) -> dict[str, SearchRow]:
        named = {row.searched: row.search for row in self.methods.values() if row.search}
        _require_known("methods' search", tuple(dict.fromkeys(named.values())), rows, self.config.search_table)
        if clash := sorted({row.searched for row in self.methods.values() if row.pool} & rows.keys()):
            rule = "no row may have a name <search>-<pool>, which is reserved for searches on a pool"
            raise InputError(self.config.search_table, rule, ", ".join(clash), "Rename the row.")
        return {name: rows[row] for name, row in named.items()}

    def _groups(self, rows: Mapping[str, ScenarioRow]) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
        """Pools and transfers: scenario -> recordings of the same object."""
        transfers = self.config.transfers or {}
        recordings = tuple(name for source, names in transfers.items() for name in (source, *names))
        _require_known("transfers", recordings, rows, self.config.scenario_table)
        transfers = {source: names for source, names in transfers.items() if source in self.config.scenarios}
        _require_alike(rows, transfers, "transfers")
        pools: dict[str, tuple[str, ...]] = {}
        if any(self.table[name].pool for name in self.whole.methods):
            for names in (self.whole.pools or {}).values():
                _require_known("pools", names, rows, self.whole.scenario_table)
                pools |= {name: tuple(other for other in names if other != name) for name in names}
            _require_alike(rows, pools, "pools")
        return pools, transfers

    # --- checks before a job starts

    def _check(self, plan_only: bool) -> None:
        folders = {*RESERVED, self.config.tables}
        for name in [*self.scenarios, *self.methods]:
            if name in folders or name.startswith("search-"):
                rule = f"must not be {', '.join(sorted(folders))} or search-..., which are folders of the results"
                remedy = "Choose another value of `tables`." if name == self.config.tables else "Rename it."
                raise InputError("name of a scenario or method", rule, name, remedy)
        for name, method in self.methods.items():
            self._check_settings(name, method)
        require_known(self.config.perception)
        shape = self.config.perception.shape
        if shape.backend == "mesh" and shape.mesh:
            from neuspring.perception.shape import read_mesh

            read_mesh(Path(shape.mesh))
        self._check_data(plan_only)
        if not any(self.applies(method, scenario) for method in self.methods for scenario in self.config.scenarios):
            rule = "at least one method must apply to a scenario; silhouettes require images, and a pool requires `pools`"
            remedy = "Choose scenarios with images (and images.enabled), set pools, or choose another method."
            raise InputError("configuration, methods", rule, ", ".join(self.methods), remedy)

    def _check_settings(self, name: str, method: Method) -> None:
        config = with_method(self.config, method, name)
        if not method.search:
            return
        row = self.searches[method.searched]
        searched = with_search(self.config, row, method.search).search.variables.stiffness
        if not method.fit:
            return
        if method.fit not in (fits := BODIES[row.body].fits):
            rule = f"must be {' or '.join(fits)} for the body {row.body} of search {method.search}"
            raise InputError(f"method {name}, fit", rule, method.fit)
        if method.oracle and config.fit.selection == "tail":
            rule = "an oracle is fitted on all frames and holds none back"
            raise InputError(f"method {name}, fit.selection", rule, "tail", "Use rollout.")
        low, high = config.fit.stiffness_range
        if not low <= searched.low < searched.high <= high:
            rule = f"must contain the search's range [{searched.low}, {searched.high}], or springs start beyond their clamp"
            raise InputError(f"method {name}, fit.stiffness_range", rule, [low, high])

    def _check_effect(self, given: Mapping[str, Any]) -> None:
        own = {name: flat(row.settings) for name, row in self.methods.items() if row.fit}
        if own and (idle := [key for key in given if all(key in settings for settings in own.values())]):
            rule, remedy = (
                "must have an effect, but every method sets this key itself",
                f"Change it in {self.config.method_table}.",
            )
            raise InputError(f"configuration, fit.{idle[0]}", rule, f"{given[idle[0]]} with {', '.join(own)}", remedy)

    def _check_data(self, plan_only: bool) -> None:
        """Report missing and invalid data of all scenarios together."""
        errors = {name: self._refused(name, path) for name in self.scenarios if (path := self.data_path(name)) is not None}
        wrong = {name: error for name, error in errors.items() if error}
        self.absent = next(iter(wrong.values()), None)
        if len(wrong) > 1:
            rule = f"the data of {len(wrong)} of {len(errors)} scenarios must exist and be readable"
            self.absent = InputError(listed(wrong, 3), rule, remedy=f"The first error: {self.absent}")
        if self.absent and not plan_only:
            raise self.absent

    def _refused(self, name: str, path: Path) -> InputError | None:
        """The first error in the data of a scenario; only small files are read."""
        row, source, root = self.scenarios[name], self.source(name), self.config.data_root
        if root is None:
            remedy = "Set it: --config data_root=/path/to/data."
            remedy += f" {source.remedy.format(data_root='/path/to/data')}" if source.needed else ""
            return InputError(f"scenario {name}", f"source {row.source} requires data_root", "null", remedy)
        for file in [path / file for file in source.needed] or [path]:
            if not file.exists():
                return InputError(f"scenario {name}", "its data must exist", file, source.remedy.format(data_root=root))
        try:
            source.required(path)
            if source.films and not source.write_capture:
                BACKENDS["segment"][self.config.perception.segment.backend].require(path)
        except InputError as error:
            return error
        return None

    # --- queries

    @property
    def compared_with(self) -> str:
        """The method with which tables compare the others."""
        wanted = self.whole.compare_with
        return wanted if wanted in self.whole.methods else self.whole.methods[0]  # type: ignore[return-value]

    def methods_of(self, study: str) -> tuple[str, ...]:
        """The selected methods of a study."""
        return tuple(name for name in rows_of(self.studies, study) if name in self.methods)

    def _row(self, name: str) -> ScenarioRow:
        """The row of a scenario, selected or not."""
        return self.scenarios.get(name) or self.whole_scenarios[name]

    def source(self, name: str) -> Source:
        """The kind of data of a scenario."""
        return SOURCES[self._row(name).source]

    def data_path(self, name: str) -> Path | None:
        """Path of a scenario's data; None for simulated scenes."""
        return location(self._row(name), self.config) if self.source(name).needs_data else None

    def has_images(self, name: str) -> bool:
        """True if the predictions of a scenario are rendered and scored."""
        source, path = self.source(name), self.data_path(name)
        return self.config.images.enabled and (source.films or (path is not None and source.images_beside(path)))

    def cameras(self, name: str) -> tuple[str, ...]:
        """Names of a scenario's cameras, also before its capture exists. Raises InputError."""
        return self.source(name).cameras(location(self._row(name), self.config), self.config)

    def applies(self, method: str, scenario: str) -> bool:
        """True if a method can run on a scenario."""
        return not self.why_not(method, scenario)

    def why_not(self, method: str, scenario: str) -> str:
        """The reason why a method cannot run on a scenario; empty if it can."""
        if self.table[self.table[method].mean_of or method].pool and scenario not in self.pools:
            return "it learns from a pool of recordings, and this scenario has no pool"
        return "it needs images" if method in self.pictured and not self.has_images(scenario) else ""

    @property
    def whole_left_out(self) -> dict[str, dict[str, str]]:
        """Methods of the complete configuration -> scenarios to which they do not apply -> the reason."""
        whole = {n: {s: why for s in self.whole_scenarios if (why := self.why_not(n, s))} for n in self.whole.methods}
        return {name: scenarios for name, scenarios in whole.items() if scenarios}


def with_references(config: Config, scenarios: Mapping[str, ScenarioRow], methods: Mapping[str, Method]) -> Config:
    """The configuration with the methods that learn nothing first, if it contains a user's own recordings."""
    if not any(SOURCES[scenarios[name].source].own for name in config.scenarios):
        return config
    beside = tuple(name for name in REFERENCES if name in methods and name not in config.methods)
    return dataclasses.replace(config, methods=beside + config.methods) if beside else config


def _require_alike(scenarios: Mapping[str, ScenarioRow], groups: Mapping[str, tuple[str, ...]], key: str) -> None:
    """Raise InputError unless all recordings of a group have the same source and category."""
    for source, target in ((s, t) for s, targets in groups.items() for t in targets):
        here, there = scenarios[source], scenarios[target]
        if (here.source, here.category) != (there.source, there.category):
            rule = f"{target} must be of the same object as {source}: source {here.source}, category {here.category}"
            raise InputError(f"configuration, {key}", rule, f"source {there.source}, category {there.category}")


def _require_known(key: str, names: tuple[str, ...], known: Mapping[str, Any], table: str) -> None:
    """Raise InputError for unknown names, with the most similar known name."""
    hints = []
    for name in (name for name in names if name not in known):
        similar = difflib.get_close_matches(name, known, n=1)
        hints.append(f"{name!r} (did you mean {similar[0]!r}?)" if similar else f"{name!r}")
    if hints:
        raise InputError(
            f"configuration, {key}", f"every entry must be a row of {table}", ", ".join(hints), f"Known: {listed(known)}"
        )
