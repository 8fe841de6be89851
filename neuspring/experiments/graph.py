"""The jobs of a benchmark: for a stage and the wildcards of a job its inputs, options, settings and code.

A stage declares what it reads and what of the tables concerns it (`neuspring.stages.stage`); here stands where that lies in the
results folder. The workflow's one rule per stage asks `inputs`, `command` and `stamp`. No stage is known by name but those whose
records tables and MLflow are made of: `score` and `transfer`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from neuspring.config import Config, Method, ScenarioRow, plain
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import Benchmark, with_method, with_search
from neuspring.stages import STAGES, makers
from neuspring.stages.stage import Member, Rows, Stage

TEMPLATE_FOLDER = Path(__file__).parents[1] / "report" / "templates"
SPLATS_FOLDER = "appearance"
"""Folder of the splats that all methods share; those of one method have its name behind a hyphen."""
NEUTRAL: dict[str, Any] = {
    "only": "",
    "effort": None,
    "gpus": {},
    "tracking": {},
    "twins_per_launch": "auto",
    "device": "auto",
    "tune": None,
}
"""Keys that no result depends on, with what stands for them where settings are compared."""
LARGEST_BATCH = 16
"""Searches or fits in a job on a GPU, where `gpus.batch` is auto. It was not measured with several scenes."""


def one_of(names: Collection[str]) -> str:
    """A pattern of exactly these names; of none, one that matches nothing."""
    return "|".join(map(re.escape, names)) or "(?!)"


class Graph:
    """Answers for the jobs of one benchmark. A job is an object with its wildcards, such as Snakemake's."""

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark, self.config = benchmark, benchmark.config
        self.results, self.root, self.whole = benchmark.config.results, benchmark.root, benchmark.whole
        self.folder = f"{self.results}/{self.config.tables}"
        """Folder of tables and report."""
        tune = self.config.tune
        self.sweep_folder = f"{self.results}/tune/{tune.study}" if tune else ""
        self._texts: dict[tuple[Any, ...], str] = {}
        self._shared: dict[str, dict[str, list[Any]]] = {}
        # Thousands of jobs share a few rows.
        self._of, self._laid = functools.cache(self._rows), functools.cache(self._lay)
        self.owners = {one.name: self._owners(one.shared) for one in STAGES.values() if one.shared}
        """Stage whose jobs methods share -> chosen method -> the first row of the method table with the same job."""
        own = dict.fromkeys([*benchmark.methods, *(owner for owners in self.owners.values() for owner in owners.values())])
        self.wildcards = {
            "scenario": one_of(benchmark.scenarios),
            "method": one_of(own),
            "search": one_of(benchmark.searches),
            "looks": one_of([SPLATS_FOLDER, *(f"{SPLATS_FOLDER}-{name}" for name in own)]),
            "camera": r"[A-Za-z0-9][A-Za-z0-9_.-]*",
            "seed": "|".join(map(str, self.whole.seeds)),
            "study": one_of(benchmark.studies),
            "launch": r"\d+",
        }
        """Pattern of each wildcard."""

    def _owners(self, shared: Callable[[Config, Method], Any]) -> dict[str, str]:
        first: dict[Any, str] = {}
        keys = {name: shared(self._laid(name, None), row) for name, row in self.benchmark.table.items()}
        owners = {name: first.setdefault(key, name) for name, key in keys.items() if key is not None}
        return {name: owner for name, owner in owners.items() if name in self.benchmark.methods}

    # --- the rows behind a job

    def rows(self, job: Any) -> Rows:
        """The rows of the tables that the wildcards of a job name."""
        method = getattr(job, "method", None)
        if looks := getattr(job, "looks", None):
            method = looks.removeprefix(SPLATS_FOLDER).removeprefix("-") or None
        return self._of(job.scenario, method, getattr(job, "search", None))

    def _rows(self, scenario: str, name: str | None, search: str | None) -> Rows:
        known = self.benchmark
        method = known.table[name] if name else None
        searched = search or (method.searched if method and method.search else None)
        kinds = {row.pool for row in known.methods.values() if row.pool and searched == row.searched}
        return Rows(
            config=self._laid(name, searched),
            scenario=known.scenarios[scenario],
            source=known.source(scenario),
            data=known.data_path(scenario),
            images=known.has_images(scenario),
            method=method,
            search=known.searches[searched] if searched else None,
            pool=known.pools.get(scenario, ()) if kinds else (),
            leave_out="others" in kinds,
            targets=known.transfers.get(scenario, ()),
        )

    def _lay(self, name: str | None, searched: str | None) -> Config:
        """The configuration with the settings of a method and of a search on top."""
        config = with_method(self.config, self.benchmark.table[name], name) if name else self.config
        return with_search(config, self.benchmark.searches[searched], searched) if searched else config

    # --- which jobs there are

    def constraints(self, stage: Stage) -> dict[str, str]:
        """Patterns of a stage's wildcards: those of rows for which it has jobs."""
        if "method" not in stage.wildcards:
            found = [name for name in self.benchmark.scenarios if stage.when(self._of(name, None, None))]
            return {"scenario": one_of(found)} if set(stage.wildcards) == {"scenario"} else {}
        names = dict.fromkeys([*self.benchmark.methods, *self.owners.get(stage.name, {}).values()])
        pairs = [(name, row) for name in names for row in self.benchmark.scenarios if stage.when(self._of(row, name, None))]
        return {
            "scenario": one_of(dict.fromkeys(row for _, row in pairs)),
            "method": one_of(dict.fromkeys(name for name, _ in pairs)),
        }

    def earliness(self, scenario: str) -> float:
        """From 1 for the first scenario that is run down to 0."""
        names = self.config.scenarios
        return 1 - names.index(scenario) / len(names) if scenario in names else 0.0

    def judged(self, names: Sequence[str]) -> dict[str, str]:
        """Scenarios whose truth is known, and their categories."""
        known = self.benchmark
        return {name: known.whole_scenarios[name].category for name in names if known.source(name).has_truth}

    def _records(self, stage: str, scenarios: Sequence[str], methods: Sequence[str] | None) -> list[str]:
        """Files that a stage writes of all runs, or of those of some methods."""
        return [
            self.output_of(STAGES[stage], SimpleNamespace(scenario=scenario, method=method, seed=seed))
            for scenario in scenarios
            for method in (self.config.methods if methods is None else methods)
            if self.benchmark.applies(method, scenario) and STAGES[stage].when(self._of(scenario, method, None))
            for seed in self.config.seeds
        ]

    def runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """The records of all runs, or of those of some methods."""
        return self._records("score", self.config.scenarios, methods)

    def transfers(self) -> list[str]:
        """Records of transfers: per source, method and seed."""
        return self._records("transfer", list(self.benchmark.transfers), None)

    def logged_runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """Files that say that a run is in MLflow; none where tracking is off."""
        return [path.replace("run.json", "mlflow.txt") for path in self.runs(methods) if self.config.tracking.enabled]

    def behind(self, stage: Stage, job: Any, known: set[str] | None = None) -> Iterator[tuple[Stage, Any]]:
        """The jobs behind a job, and then itself; not those of one camera."""
        known = set() if known is None else known
        if "camera" in stage.wildcards or (output := self.output_of(stage, job)) in known:
            return
        known.add(output)
        for name in stage.inputs:
            for maker, other in self._makers(stage, name, job):
                yield from self.behind(maker, other, known)
        yield stage, job

    # --- what a job reads

    def inputs(self, stage: Stage) -> Callable[..., dict[str, Any]]:
        """Wildcards of a job -> its input files by parameter; `also`: files that it depends on beside them."""

        def found(wildcards: Any) -> dict[str, Any]:
            files: dict[str, Any] = {}
            for name, parameter in stage.inputs.items():
                paths = self._find(stage, name, wildcards)
                files[name] = paths if parameter.many else paths[0] if paths else None
            also = [str(path) for path in stage.also(self.rows(wildcards))]
            members = [one.inputs for one in self.members(stage, wildcards)]
            others = [paths for one in members for name, paths in one.items() if name not in stage.inputs]
            also += dict.fromkeys(path for paths in others for path in ([paths] if isinstance(paths, str) else paths))
            return {name: paths for name, paths in (files | {"also": also}).items() if paths}

        return found

    def _find(self, stage: Stage, name: str, job: Any) -> list[str]:
        """The files of a parameter; none where a job goes without."""
        rows = self.rows(job)
        if name in stage.without(rows):
            return []
        made = [self.output_of(maker, other) for maker, other in self._makers(stage, name, job)]
        return made or [str(path) for maker in makers(name) if not maker.when(rows) and (path := maker.instead(rows))]

    def _makers(self, stage: Stage, name: str, job: Any) -> list[tuple[Stage, Any]]:
        """The jobs that make the files of a parameter: one of its maker, or one of each camera or recording."""
        rows, parameter = self.rows(job), stage.inputs[name]
        if name in stage.without(rows):
            return []
        if parameter.many and parameter.type is Observations:
            return [(one, SimpleNamespace(scenario=other)) for one in makers("observations") for other in getattr(rows, name)]
        if parameter.many and rows.method and rows.method.mean_of:
            seeds = self.whole.seeds
            others = [SimpleNamespace(scenario=job.scenario, method=rows.method.mean_of, seed=seed) for seed in seeds]
            return [(one, other) for other in others for one in makers(name) if one.when(self.rows(other))]
        found = [one for one in makers(name) if one.when(rows)]
        if not found:
            return []
        maker, method = found[0], getattr(job, "method", None)
        owners = self.owners.get(maker.name, {})
        owner = owners.get(method or "")
        values = {
            "scenario": job.scenario,
            "seed": getattr(job, "seed", None),
            "method": owner or method,
            "search": rows.method.searched if rows.method else None,
            "looks": f"{SPLATS_FOLDER}-{owner}" if owner else SPLATS_FOLDER,
        }
        wildcards = {wildcard: values[wildcard] for wildcard in maker.wildcards if wildcard != "camera"}
        if "camera" not in maker.wildcards:
            return [(maker, SimpleNamespace(**wildcards))]
        cameras = self._cameras(job.scenario) if parameter.many else [job.camera]
        return [(maker, SimpleNamespace(**wildcards, camera=camera)) for camera in cameras]

    def _cameras(self, scenario: str) -> tuple[str, ...]:
        try:
            return self.benchmark.cameras(scenario)
        except InputError:
            # Damaged data must fail the jobs of their scenario, which say what is wrong, and not the planning of all.
            return ("0",)

    def output_of(self, stage: Stage, job: Any) -> str:
        """The file that a job writes."""
        return f"{self.results}/{stage.output.format(**{name: getattr(job, name) for name in stage.wildcards})}"

    # --- jobs that share launches

    def together(self, stage: Stage) -> Stage | None:
        """The stage that does the jobs of a stage together; None if there is none."""
        return next((one for one in STAGES.values() if one.together and one.together.stage == stage.name), None)

    def shared_launches(self, stage: Stage, job: Any) -> list[str]:
        """The record of the launches that a job shared with others, if it is one of several."""
        shared, output = self.together(stage), self.output_of(stage, job)
        launches = self._launches(shared) if shared else {}
        return [path for path, members in launches.items() if output in (self.output_of(stage, one) for one in members)]

    def members(self, stage: Stage, job: Any) -> list[Member]:
        """The jobs that a job does together; none for other stages."""
        if not stage.together:
            return []
        other = STAGES[stage.together.stage]
        return [
            Member(
                output=self.output_of(other, one),
                inputs=self.inputs(other)(one),
                options=self.options(other, one),
                settings=self.settings(other, one),
            )
            for one in self.in_step(stage, job)
        ]

    def in_step(self, stage: Stage, job: Any) -> list[Any]:
        """The jobs that a job does together."""
        return self._launches(stage).get(self.output_of(stage, job), [])

    def _launches(self, stage: Stage) -> dict[str, list[Any]]:
        """Record of each job that does others together -> these: of one scenario, or with `gpus.batch` of all.

        None where `twins_per_launch` is 1.
        """
        if self.config.twins_per_launch != 1 and stage.name not in self._shared:
            self._shared[stage.name] = self._batches(stage)
        return self._shared.get(stage.name, {})

    def _batches(self, stage: Stage) -> dict[str, list[Any]]:
        assert stage.together
        alike: dict[Any, list[Any]] = defaultdict(list)
        for one in self._jobs(STAGES[stage.together.stage]):
            if (key := stage.together.key(self.rows(one))) is not None:
                alike[key].append(one)
        # Without batches a job does all of its scenario that are in step with enough others.
        of_scenarios: dict[str, list[Any]] = defaultdict(list)
        batches: list[list[Any]] = []
        for jobs in alike.values():
            if (most := self._most(len(jobs))) > 1:
                parts, total = -(-len(jobs) // most), len(jobs)
                # As large as one another.
                batches += [jobs[total * part // parts : total * (part + 1) // parts] for part in range(parts)]
            elif (fewest := stage.together.alone) is not None:
                counts = Counter(one.scenario for one in jobs)
                for one in jobs:
                    of_scenarios[one.scenario] += [one] * (counts[one.scenario] >= fewest)
        made: dict[str, list[Any]] = {}
        numbers: Counter[str] = Counter()
        for members in [*(batch for batch in batches if len(batch) > 1), *filter(None, of_scenarios.values())]:
            first = members[0].scenario
            made[self.output_of(stage, SimpleNamespace(scenario=first, launch=numbers[first]))] = members
            numbers[first] += 1
        return made

    def _most(self, jobs: int) -> int:
        """Jobs that are done together at most, of so many that are alike."""
        if self.config.gpus.batch != "auto":
            return self.config.gpus.batch
        slots = self.benchmark.gpu_slots
        return 1 if not self.benchmark.on_gpu else min(LARGEST_BATCH, -(-jobs // slots) if slots else LARGEST_BATCH)

    def _jobs(self, stage: Stage) -> list[Any]:
        """The jobs of all runs of a stage that learns, of methods or of searches, scenario by scenario."""
        known, found = self.benchmark, []
        for scenario in self.config.scenarios:
            if "method" in stage.wildcards:
                kind, names = "method", [name for name in self.owners[stage.name].values() if known.applies(name, scenario)]
            else:
                rows = [row for name, row in known.methods.items() if row.search and known.applies(name, scenario)]
                kind, names = "search", [row.searched for row in rows]
            found += [
                SimpleNamespace(scenario=scenario, seed=seed, **{kind: name})
                for name in dict.fromkeys(names)
                for seed in self.config.seeds
            ]
        return found

    # --- what a job is told

    def command(self, stage: Stage) -> Callable[..., str]:
        """Wildcards and inputs of a job -> its command line, without where it runs and where it writes."""

        def line(wildcards: Any, input: Any) -> str:
            files = {name: _paths(input.get(name), parameter.many) for name, parameter in stage.inputs.items()}
            text = self.settings(stage, wildcards)
            settings = [] if text == "{}" else ["--settings", text]
            return shlex.join([stage.name, *stage.words(files | self.options(stage, wildcards)), *settings])

        return line

    def options(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The options of a job's stage, by name."""
        rows = self.rows(job)
        given = dict(stage.given(rows))
        if stage.together:
            given |= stage.together.given(self.members(stage, job))
        for name, option in stage.options.items():
            if option.type is ScenarioRow:
                given[name] = plain(rows.scenario)
            elif name not in given:
                # What rows do not tell has the default of the signature; a required one is a wildcard.
                given[name] = getattr(job, name) if option.required else getattr(job, name, option.default)
        return {name: given[name] for name in stage.options}

    def recorded(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The settings and options that the record of a job would hold."""
        options = self.options(stage, job)
        # Wildcards are text.
        options |= {name: int(options[name]) for name, option in stage.options.items() if option.type is int}
        values: dict[str, Any] = json.loads(_json(json.loads(self.settings(stage, job)) | options))
        return values

    def settings(self, stage: Stage, job: Any) -> str:
        """The settings that a stage reads, as JSON, so that changing another one runs nothing again."""
        # Thousands of jobs share a few texts: those of one source and one row.
        rows = (getattr(job, name, None) for name in ("method", "search", "looks"))
        key = (stage.name, self.benchmark.scenarios[job.scenario].source, *rows)
        if key not in self._texts:
            self._texts[key] = _json(stage.settings(stage.settled(self.rows(job)), self._given(stage, job)))
        return self._texts[key]

    def _given(self, stage: Stage, job: Any) -> dict[str, Any]:
        """Values of parameters that `reads` and `code` of a stage ask for: what rows tell, and which inputs there are."""
        files = {name: self._find(stage, name, job) for name in stage.inputs}
        rows = self.rows(job)
        row = {name: rows.scenario for name, option in stage.options.items() if option.type is ScenarioRow}
        return {**stage.given(rows), **row, **files}

    # --- what makes a job run again beside its command

    def code(self, stage: Stage, job: Any) -> str:
        """The digest of the code that makes a job's result."""
        return stage.code_of(stage.settled(self.rows(job)), self._given(stage, job))

    def stamp(self, stage: Stage) -> Callable[..., str]:
        """Wildcards of a job -> what no record holds of it: images that a capture is made of, weights that are there.

        Settings, code and inputs are compared with the records themselves (`neuspring.experiments.freshness`).
        """
        return lambda wildcards: stage.stamp(self.rows(wildcards))

    def gpu(self, stage: Stage) -> Callable[..., int]:
        """Wildcards of a job -> 1 where it takes a GPU if there is one."""

        def taken(wildcards: Any) -> int:
            wanted = stage.gpu(stage.settled(self.rows(wildcards))) if callable(stage.gpu) else stage.gpu
            return int(self.benchmark.on_gpu and wanted)

        return taken

    # --- what commands are told that look at many runs: those of the whole benchmark, whatever part runs now

    def tables(self, output: str = "") -> list[str]:
        """Options of `neuspring tables`; into `output` instead of the folder of tables."""
        objects = [] if self.config.objects == "scenario" else ["--objects", self.config.objects]
        aims = ["--aims", _json(plain(self.config)["aims"])] if self.config.aims else []
        compared = ["--baseline", self.benchmark.compared_with]
        settings = ["--settings", _json(plain(self.whole) | NEUTRAL)]
        studies = ["--studies", *self.whole.studies] if self.whole.studies else []
        more = [*compared, *objects, *aims, *studies, *self._row_tables(), *settings]
        return [*self._runs(output or self.folder), *self._transfers(), *more]

    def study(self, name: str, part: str = "") -> list[str]:
        """Options of `neuspring study`, of the folder of tables or a part of it."""
        tables = "/".join(word for word in (self.config.tables, part) if word)
        return ["--study", name, "--results", self.results, "--tables", tables, "--output", f"{self.results}/{tables}/studies"]

    def _row_tables(self) -> list[str]:
        """Options that name the tables of studies and methods."""
        extra = [str(path) for path in self.benchmark.extra]
        tables = ["--table", str(self.root / self.config.study_table), "--method-table", str(self.root / self.config.method_table)]
        return [*tables, *(["--extra-rows", *extra] if extra else [])]

    def perception(self) -> list[str]:
        """Options of `neuspring perception-table`."""
        return ["--results", self.results, "--scenarios", json.dumps(self.judged(self.whole.scenarios))]

    def report(self, output: str = "") -> list[str]:
        """Options of `neuspring report`; to the file `output` instead of the one in the folder of tables."""
        values = plain(self.whole) | {"only": ""}
        # Where MLflow lies concerns nothing that the report shows.
        del values["tracking"]
        return [
            *("--results", self.results, "--output", output or f"{self.folder}/report.html", "--settings", _json(values)),
            *(*self._row_tables(), "--tables", self.config.tables),
            *("--baseline", self.benchmark.compared_with, *self._transfers(), *self._left_out()),
        ]

    def _runs(self, output: str) -> list[str]:
        whole = self.whole
        runs = ["--scenarios", *whole.scenarios, "--methods", *whole.methods, "--seeds", *map(str, whole.seeds)]
        return ["--results", self.results, "--output", output, *runs, *self._left_out()]

    def _transfers(self) -> list[str]:
        sources = [name for name in self.whole.transfers or {} if name in self.whole.scenarios]
        return ["--transfers", *sources] if sources else []

    def _left_out(self) -> list[str]:
        """The methods that do not apply to some scenarios, so that nothing is missing there."""
        left_out = self.benchmark.whole_left_out
        return ["--left-out", _json(left_out)] if left_out else []

    def report_stamp(self) -> list[str]:
        """Digests of the report's templates, which that of its code does not hold, and of the sweep's summary, if it is there.

        A sweep costs much: it is no input of the report, so that changed settings do not run it again.
        """
        summary = Path(self.sweep_folder) / "summary.md"
        texts = [b"".join(path.read_bytes() for path in sorted(TEMPLATE_FOLDER.iterdir()))]
        texts += [summary.read_bytes()] if self.sweep_folder and summary.exists() else []
        return [hashlib.sha256(text).hexdigest()[:16] for text in texts]

    def sweep_targets(self) -> list[str]:
        """Files of the target `sweep`. Raises InputError if the configuration has none."""
        if not self.sweep_folder:
            remedy = "Add the section `tune` (config/README.md, config/studies/tune.yaml)."
            raise InputError("configuration, tune", "the target sweep needs a sweep", None, remedy)
        return [f"{self.sweep_folder}/summary.md"]


def _paths(files: Any, many: bool) -> Any:
    if files is None:
        return None
    paths = [files] if isinstance(files, str) else [str(path) for path in files]
    return paths if many else paths[0]


def _json(values: Any) -> str:
    return json.dumps(values, sort_keys=True)
