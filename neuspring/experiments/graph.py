"""The jobs of a benchmark: for a stage and the wildcards of a job its inputs, options, settings and code.

A stage's signature says what it reads; here stands where that lies in the results folder, and what the rows of a configuration give
it. The workflow's one rule per stage asks `inputs`, `command` and `stamp`.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from neuspring.baselines import BASELINES
from neuspring.config import Config, Search, SpringField, plain
from neuspring.config.settings import select
from neuspring.core.errors import InputError
from neuspring.core.provenance import image_stamps
from neuspring.experiments.benchmark import Benchmark, read_methods, read_searches, rows_of, section_of, with_method, with_search
from neuspring.perception.backends import BACKENDS
from neuspring.scenes.sources import SOURCES
from neuspring.scores.lpips import configured_weights
from neuspring.stages import STAGES
from neuspring.stages.stage import Stage

TEMPLATES = Path(__file__).parents[1] / "report" / "templates"
SPLATS = "appearance"
"""Folder of the splats that all methods share; those of one method have its name behind a hyphen."""
NEUTRAL: dict[str, Any] = {"only": "", "gpus": {}, "tracking": {}, "twins_per_launch": "auto", "device": "auto", "tune": None}
"""Keys that no result depends on, with what stands for them where settings are compared."""
Files = str | list[str]
_stamps = functools.cache(image_stamps)


def one_of(names: Sequence[str]) -> str:
    """A pattern of exactly these names; of none, one that matches nothing."""
    return "|".join(map(re.escape, names)) or "(?!)"


class Graph:
    """Answers for the jobs of one benchmark."""

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark, self.config = benchmark, benchmark.config
        self.results, self.root, self.whole = benchmark.config.results, benchmark.root, benchmark.whole
        self.folder = f"{self.results}/{self.config.tables}"
        """Of tables and report."""
        tune = self.config.tune
        self.sweep_folder = f"{self.results}/tune/{tune.study}" if tune else ""
        self._texts: dict[tuple[str, str, str], str] = {}

    # --- which jobs there are

    def constraints(self, stage: Stage) -> dict[str, str]:
        """Patterns of a stage's wildcards, where they are narrower than those of all rules."""
        rows = self.benchmark.methods.items()
        sources = {name: self.benchmark.source(name) for name in self.benchmark.scenarios}
        trained = {name for name, baseline in BASELINES.items() if baseline.trained}
        return {
            "capture": {"scenario": one_of([name for name, source in sources.items() if source.write_capture])},
            "judge": {"scenario": one_of([name for name, source in sources.items() if source.has_truth])},
            "rollout": {"method": one_of([name for name, row in rows if row.search])},
            "predict": {"method": one_of([name for name, row in rows if row.model])},
            "train": {"method": one_of([name for name, row in rows if row.model in trained])},
            "appearance": {"looks": one_of([SPLATS, *(f"{SPLATS}-{name}" for name in self.benchmark.splats)])},
        }.get(stage.name, {})

    def earliness(self, scenario: str) -> float:
        """From 1 for the first scenario that is run down to 0."""
        names = self.config.scenarios
        return 1 - names.index(scenario) / len(names) if scenario in names else 0.0

    def behind(self, scenario: str, method: str, seed: int) -> list[tuple[Stage, Any]]:
        """The jobs behind a run's scores, but for those of one camera."""
        row, job = self.benchmark.methods[method], SimpleNamespace(scenario=scenario, method=method, seed=seed)
        source = self.benchmark.source(scenario)
        names = ["capture"] * bool(source.write_capture) + ["lift"] * source.films + ["observe"]
        jobs = [(STAGES[name], job) for name in names]
        if row.search:
            jobs.append((STAGES["search"], SimpleNamespace(scenario=scenario, search=row.searched, seed=seed)))
        if owner := self.benchmark.fit_of_method.get(method):
            jobs.append((STAGES["fit"], SimpleNamespace(scenario=scenario, method=owner, seed=seed)))
        if row.model:
            jobs += [(STAGES[name], job) for name in ("train", "predict") if name == "predict" or BASELINES[row.model].trained]
        else:
            jobs.append((STAGES["rollout"], job))
        return [*jobs, *([(STAGES["render"], job)] if self.benchmark.has_images(scenario) else []), (STAGES["score"], job)]

    def judged(self, names: Sequence[str]) -> dict[str, str]:
        """Scenarios whose truth is known, and their categories."""
        rows = self.benchmark.whole_scenarios
        return {name: rows[name].category for name in names if SOURCES[rows[name].source].has_truth}

    def runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """The records of all runs, or of those of some methods."""
        return [
            self._output("score", scenario=scenario, method=method, seed=seed)
            for scenario in self.config.scenarios
            for method in (self.config.methods if methods is None else methods)
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    def logged_runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """Files that say that a run is in MLflow; none where tracking is off."""
        return [path.replace("run.json", "mlflow.txt") for path in self.runs(methods) if self.config.tracking.enabled]

    def study_runs(self, name: str) -> list[str]:
        """The records that a study is made of."""
        moved = self.transfers() if self.benchmark.studies[name].clips else ()
        return [*self.runs(self.benchmark.methods_of(name)), *moved]

    def transfers(self) -> list[str]:
        """Records of transfers: per source, method and seed. Oracles concern their own recording alone, and are not transferred."""
        methods = [
            name
            for name, method in self.benchmark.methods.items()
            if (method.search or (method.model and BASELINES[method.model].transfers)) and not method.oracle
        ]
        return [
            self._output("transfer", scenario=scenario, method=method, seed=seed)
            for scenario in self.benchmark.transfers
            for method in methods
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    # --- what a job reads

    def inputs(self, stage: Stage) -> Callable[..., dict[str, Any]]:
        """Wildcards of a job -> its input files by parameter; `also`: files that it depends on beside them."""

        def found(wildcards: Any) -> dict[str, Any]:
            files = {name: self._find(stage, name, wildcards) for name in stage.inputs}
            return {name: paths for name, paths in (files | {"also": self._also(stage, wildcards)}).items() if paths}

        return found

    def _find(self, stage: Stage, name: str, job: Any) -> Files:
        """The files of a parameter; none where a job goes without."""
        source = self.benchmark.source(job.scenario)
        pictured = stage.name not in ("train", "predict") or self.pictured(job)
        match name:
            case "capture":
                wanted = pictured and (source.films or stage.name != "observe")
                return f"{self.benchmark.capture_folder(job.scenario)}/capture.json" if wanted else []
            case "masks" | "tracks":
                if not pictured:
                    return []
                maker = next(other for other in STAGES.values() if other.product == name)
                cameras = self._cameras(job.scenario) if stage.inputs[name].many else [job.camera]
                return [self._output(maker.name, scenario=job.scenario, camera=camera) for camera in cameras]
            case "lifted":
                return self._output("lift", scenario=job.scenario) if source.films else []
            case "observations":
                # Perception's record says more than the observations where splats begin.
                return [] if stage.name == "appearance" and source.films else self._observations(job.scenario)
            case "pool":
                others = self.benchmark.pools[job.scenario] if self.benchmark.pool_kind(job) else ()
                return [self._observations(other) for other in others]
            case "targets":
                return [self._observations(target) for target in self.benchmark.transfers[job.scenario]]
            case "search":
                method = (self.benchmark.methods | self.benchmark.fits)[job.method]
                return [] if method.model else self._search(job)
            case "fit":
                owner = self.benchmark.fit_of_method.get(job.method)
                return self._output("fit", scenario=job.scenario, method=owner, seed=job.seed) if owner else []
            case "train":
                model = self.benchmark.methods[job.method].model
                trained = bool(model and BASELINES[model].trained)
                return self._output("train", scenario=job.scenario, method=job.method, seed=job.seed) if trained else []
            case "learned":
                return next(files for maker in ("train", "fit", "search") if (files := self._find(stage, maker, job)))
            case "appearance":
                if not (pictured and self.benchmark.has_images(job.scenario)):
                    return []
                owner = self.benchmark.splats_of_method.get(job.method)
                looks = f"{SPLATS}-{owner}" if owner else SPLATS
                return self._output("appearance", scenario=job.scenario, looks=looks, seed=job.seed)
            case "render" if not self.benchmark.has_images(job.scenario):
                return []
        return self.output_of(next(other for other in STAGES.values() if other.product == name), job)

    def _also(self, stage: Stage, job: Any) -> list[str]:
        """Files without which a job cannot run, or whose change makes it run again, and which its command does not name."""
        source, folder = self.benchmark.source(job.scenario), self.benchmark.data_path(job.scenario)
        match stage.name:
            case "capture":
                return [str(folder / name) for name in source.capture_files if folder and (folder / name).exists()]
            case "observe" if folder and not source.films:
                if folder.is_file():
                    return [str(folder)]
                return [str(folder / name) for name in source.files if (folder / name).exists()]
            case "lift" if self.config.perception.shape.mesh:
                return [str(self.config.perception.shape.mesh)]
            case "fits":
                return list(dict.fromkeys(self._search(member) for member in self.members(job.scenario)))
        return []

    def shared_launches(self, job: Any) -> list[str]:
        """The record of the launches that a fit shared with others, if it is one of several."""
        together = (job.method, int(job.seed)) in self.benchmark.fits_together(job.scenario)
        return [self._output("fits", scenario=job.scenario)] if together else []

    def output_of(self, stage: Stage, job: Any) -> str:
        """The file that a job writes."""
        return self._output(stage.name, **{name: getattr(job, name) for name in stage.wildcards})

    def recorded(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The settings and options that the record of a job would hold."""
        options = self.options(stage, job)
        # Wildcards are text.
        options |= {name: int(options[name]) for name, option in stage.options.items() if option.type is int}
        values: dict[str, Any] = json.loads(_json(json.loads(self.settings(stage, job)) | options))
        return values

    def _output(self, stage: str, **wildcards: Any) -> str:
        return f"{self.results}/{STAGES[stage].output.format(**wildcards)}"

    def _observations(self, scenario: str) -> str:
        return self._output("observe", scenario=scenario)

    def _search(self, job: Any) -> str:
        method = (self.benchmark.methods | self.benchmark.fits)[job.method]
        return self._output("search", scenario=job.scenario, search=method.searched, seed=job.seed)

    def _cameras(self, scenario: str) -> tuple[str, ...]:
        try:
            return self.benchmark.cameras(scenario)
        except InputError:
            # Damaged data must fail the jobs of their scenario, which say what is wrong, and not the planning of all.
            return ("0",)

    def pictured(self, job: Any) -> bool:
        """Whether the method is trained on pictures, and moves splats itself."""
        return job.method in self.benchmark.pictured

    def members(self, scenario: str) -> list[Any]:
        """The fits of a scenario that share launches."""
        pairs = self.benchmark.fits_together(scenario)
        return [SimpleNamespace(scenario=scenario, method=method, seed=seed) for method, seed in pairs]

    # --- what a job is told

    def command(self, stage: Stage) -> Callable[..., str]:
        """Wildcards and inputs of a job -> its command line, without where it runs and where it writes."""

        def line(wildcards: Any, input: Any) -> str:
            files = {name: _paths(input.get(name), parameter.many) for name, parameter in stage.inputs.items()}
            return shlex.join([stage.name, *stage.words(files | self.options(stage, wildcards)), *self._settings(stage, wildcards)])

        return line

    def _settings(self, stage: Stage, job: Any) -> list[str]:
        text = self.settings(stage, job)
        return [] if text == "{}" else ["--settings", text]

    def options(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The options of a job's stage, by name."""
        return {name: self._option(name, stage, job) for name in stage.options}

    def _option(self, name: str, stage: Stage, job: Any) -> Any:
        rows = self.benchmark
        match name:
            case "scenario":
                return plain(rows.scenarios[job.scenario])
            case "clusters":
                return rows.searches[job.search].clusters
            case "body":
                return rows.searches[job.search].body
            case "leave_out":
                return rows.pool_kind(job) == "others"
            case "kind":
                return rows.fits[job.method].fit
            case "oracle":
                return rows.fits[job.method].oracle
            case "model":
                return rows.methods[job.method].model
            case "variant":
                return self.variant(job)
            case "rows":
                return self._rows_of_fits(job.scenario)
        # What the workflow does not know has the default of the signature; a required one is a wildcard.
        option = stage.options[name]
        return getattr(job, name) if option.required else getattr(job, name, option.default)

    def _rows_of_fits(self, scenario: str) -> str:
        """The fits of a scenario that share launches, by row of the method table, as JSON."""
        rows: dict[str, dict[str, Any]] = {}
        for member in self.members(scenario):
            method = self.benchmark.fits[member.method]
            row: dict[str, Any] = {"kind": method.fit, "oracle": method.oracle, "fits": {}}
            row["settings"] = self.settings(STAGES["fit"], member)
            made = self._output("fit", scenario=scenario, method=member.method, seed=member.seed)
            rows.setdefault(member.method, row)["fits"][made] = self._search(member)
        return _json(list(rows.values()))

    def variant(self, job: Any) -> dict[str, Any]:
        """The switches of a method, for the record of its run."""
        method = self.benchmark.methods[job.method]
        settings: dict[str, Any] = plain(method)["settings"]
        if method.model:
            return {"model": method.model, **settings}
        row = self.benchmark.searches[method.searched]
        switches: dict[str, Any] = {"search": method.search, "clusters": row.clusters, "fit": method.fit or "none"}
        switches |= {"pool": method.pool} if method.pool else {}
        # Named only where it is one: runs of other rows are compared with it nowhere.
        switches |= {"oracle": True} if method.oracle else {}
        switches |= {"released_quirks": sorted(key for key, on in row.released_quirks.items() if on)} if row.released_quirks else {}
        return switches | settings

    def settings(self, stage: Stage, job: Any) -> str:
        """The settings that a stage reads, as JSON, so that changing another one runs nothing again."""
        own = {"search": "search", "fit": "method", "train": "method", "appearance": "looks"}.get(stage.name)
        # Thousands of jobs share a few texts: those of one source and one row.
        key = (stage.name, self.benchmark.scenarios[job.scenario].source, getattr(job, own) if own else "")
        if key not in self._texts:
            self._texts[key] = _json(stage.settings(self.config_of(stage, job), self._given(stage, job)))
        return self._texts[key]

    def _given(self, stage: Stage, job: Any) -> dict[str, Any]:
        """What declarations of a stage ask for: its options, and which inputs there are."""
        given = self.options(stage, job) if stage.name != "fits" else {}
        method = self.benchmark.methods.get(getattr(job, "method", ""))
        given |= {"model": method.model} if method else {}
        if "scenario" in given:
            given["scenario"] = self.benchmark.scenarios[job.scenario]
        return given | {name: self._find(stage, name, job) for name in stage.inputs}

    def config_of(self, stage: Stage, job: Any) -> Config:
        """The configuration of a stage's job: with what the rows of its method and search lay on top.

        What such a row does not read has its default, so that changing it does not run the job again.
        """
        config, rows = self.config, self.benchmark
        if stage.name == "segment" and not rows.source(job.scenario).films:
            # Processed data have masks; those are taken, whatever segments raw video.
            given = dataclasses.replace(config.perception.segment, backend="given")
            return dataclasses.replace(config, perception=dataclasses.replace(config.perception, segment=given))
        if stage.name == "search":
            row = rows.searches[job.search]
            config = with_search(config, row, job.search)
            # These concern nothing where there is one region.
            alone: dict[str, Any] = {"tied_rollouts": Search().tied_rollouts} if row.clusters == 1 else {}
            return dataclasses.replace(config, search=dataclasses.replace(config.search, **alone))
        if stage.name == "fit":
            method = rows.fits[job.method]
            config = with_search(with_method(config, method, job.method), rows.searches[method.searched], method.searched)
            unread: dict[str, Any] = {"field": SpringField()} if method.fit == "springs" else {}
            return dataclasses.replace(config, fit=dataclasses.replace(config.fit, **unread))
        if stage.name == "train":
            return with_method(config, rows.methods[job.method], job.method)
        if stage.name == "appearance" and job.looks != SPLATS:
            name = job.looks.removeprefix(f"{SPLATS}-")
            return with_method(config, rows.splats[name], name)
        return config

    # --- what makes a job run again beside its command

    def code(self, stage: Stage, job: Any) -> str:
        """The digest of the code that makes a job's result."""
        return stage.code_of(self.config_of(stage, job), self._given(stage, job))

    def stamp(self, stage: Stage) -> Callable[..., str]:
        """Wildcards of a job -> what no record holds of it: images that a capture is made of, weights that are there.

        Settings, code and inputs are compared with the records themselves (`neuspring.experiments.freshness`).
        """

        def digest(wildcards: Any) -> str:
            config, parts = self.config_of(stage, wildcards), []
            if stage.name == "capture":
                parts.append(self.image_stamps(wildcards.scenario))
            if stage.name == "render":
                parts.append("absent" if isinstance(configured_weights(self.config.images.lpips), str) else "found")
            if stage.name == "train" and self.pictured(wildcards):
                method = self.benchmark.methods[wildcards.method]
                parts.append(BASELINES[method.model or ""].features(section_of(config, method)))
            return " ".join(parts)

        return digest

    def image_stamps(self, scenario: str) -> str:
        """A digest that tells changed images of the user's apart; empty where images are made here, or there are none."""
        folder, source = self.benchmark.data_path(scenario), self.benchmark.source(scenario)
        return _stamps(folder) if folder and (source.films or source.capture_files) else ""

    def gpu(self, stage: Stage) -> Callable[..., int]:
        """Wildcards of a job -> 1 where it takes a GPU if there is one."""

        def taken(wildcards: Any) -> int:
            if stage.gpu == "backend":
                backend = getattr(self.config_of(stage, wildcards).perception, stage.name).backend
                return int(self.benchmark.on_gpu and BACKENDS[stage.name][backend].gpu)
            return int(self.benchmark.on_gpu and stage.gpu == "always")

        return taken

    # --- what commands are told that look at many runs: those of the whole benchmark, whatever part runs now

    def tables(self, output: str = "") -> list[str]:
        """Of `neuspring tables`; into `output` instead of the folder of tables."""
        objects = [] if self.config.objects == "scenario" else ["--objects", self.config.objects]
        aims = ["--aims", _json(plain(self.config)["aims"])] if self.config.aims else []
        compared = ["--baseline", self.benchmark.compared_with]
        settings = ["--settings", _json(plain(self.whole) | NEUTRAL)]
        return [*self._runs(output or self.folder), *self._transfers(), *compared, *objects, *aims, *settings]

    def study(self, name: str) -> list[str]:
        """Of `neuspring study`."""
        # Of the methods those that it shows: it is the same table however many others the configuration names.
        shown = [method for method in rows_of(self.benchmark.studies, name) if method in self.whole.methods]
        table = str(self.root / self.config.study_table)
        return ["--study", name, "--table", table, *self._runs(f"{self.folder}/studies", shown)]

    def perception(self) -> list[str]:
        """Of `neuspring perception-table`."""
        return ["--results", self.results, "--scenarios", json.dumps(self.judged(self.whole.scenarios))]

    def report(self, output: str = "") -> list[str]:
        """Of `neuspring report`; to the file `output` instead of the one in the folder of tables."""
        values = plain(self.whole) | {"only": ""}
        # Where MLflow lies concerns nothing that the report shows.
        del values["tracking"]
        return [
            *("--results", self.results, "--output", output or f"{self.folder}/report.html", "--settings", _json(values)),
            *("--table", str(self.root / self.config.study_table), "--tables", self.config.tables),
            *("--baseline", self.benchmark.compared_with, *self._transfers(), *self._left_out()),
        ]

    def _runs(self, output: str, methods: Sequence[str] = ()) -> list[str]:
        whole, names = self.whole, methods or self.whole.methods
        runs = ["--scenarios", *whole.scenarios, "--methods", *names, "--seeds", *map(str, whole.seeds)]
        return ["--results", self.results, "--output", output, *runs, *self._left_out(names)]

    def _transfers(self) -> list[str]:
        sources = [name for name in self.whole.transfers or {} if name in self.whole.scenarios]
        return ["--transfers", *sources] if sources else []

    def _left_out(self, methods: Sequence[str] = ()) -> list[str]:
        """Which methods (of all or of these) do not apply to which scenarios, so that nothing is missing there."""
        left_out = {name: where for name, where in self.benchmark.whole_left_out.items() if not methods or name in methods}
        return ["--left-out", _json(left_out)] if left_out else []

    def report_stamp(self) -> list[str]:
        """Digests of the report's templates, which that of its code does not hold, and of the sweep's summary, if it is there.

        A sweep costs much: it is no input of the report, so that changed settings do not run it again.
        """
        summary = Path(self.sweep_folder) / "summary.md"
        texts = [b"".join(path.read_bytes() for path in sorted(TEMPLATES.iterdir()))]
        texts += [summary.read_bytes()] if self.sweep_folder and summary.exists() else []
        return [hashlib.sha256(text).hexdigest()[:16] for text in texts]

    def sweep_targets(self) -> list[str]:
        """Files of the target `sweep`. Raises InputError if the configuration has none."""
        if not self.sweep_folder:
            remedy = "Add the section `tune` (config/README.md, config/studies/tune.yaml)."
            raise InputError("configuration, tune", "the target sweep needs a sweep", None, remedy)
        return [f"{self.sweep_folder}/summary.md"]

    def sweep(self) -> str:
        """Settings of a sweep's workers, as JSON; its tables of methods and searches are found wherever a job runs."""
        values = select(self.config, ("simulation", "losses", "search", "fit", "released_quirks", "tune"))
        tables = {name: str(self.root / getattr(self.config, name)) for name in ("method_table", "search_table")}
        return _json(values | tables | {"scenarios": list(self.whole.scenarios)})

    def tuned_rows(self) -> str:
        """The rows of the method that is varied, so that changed ones are tuned again."""
        assert self.config.tune
        method = read_methods(self.root / self.config.method_table)[self.config.tune.method]
        search = read_searches(self.root / self.config.search_table)[method.search or ""]
        return _json([plain(method), plain(search)])


def _paths(files: Any, many: bool) -> Any:
    if files is None:
        return None
    paths = [files] if isinstance(files, str) else [str(path) for path in files]
    return paths if many else paths[0]


def _json(values: Any) -> str:
    return json.dumps(values, sort_keys=True)
