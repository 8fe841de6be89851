"""The jobs of a benchmark: the steps of each job, their inputs, and the digest of everything that their results depend on.

Stages declare what they read from files and tables (`neuspring.stages.stage`). A `Unit` is a job, or a member of a batch: the
stages of one rule with the same wildcards. Its digest covers the settings, code and inputs of its steps; an input that another
step makes counts with the digest of that step. The record of a finished unit has the digest as its name.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from neuspring.config import Config, Method, ScenarioRow, plain
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER, JobRecord
from neuspring.core.provenance import file_stamp
from neuspring.experiments.benchmark import Benchmark, with_method, with_search
from neuspring.stages import STAGES, makers
from neuspring.stages.stage import Job, Rows, Stage

SPLATS_FOLDER = "appearance"
"""Folder of the shared splats; for splats of one method, a hyphen and the method's name follow."""
BATCH = "together"
"""First part of the name of a batch."""
LARGEST_BATCH = 16
"""Maximum size of a batch on a GPU with `gpus.batch: auto`. Not measured with several scenes."""


@dataclass(frozen=True)
class Step:
    """One call of a stage."""

    stage: Stage
    job: Any
    """An object whose attributes are the wildcards."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Unit:
    """A job, or a member of a batch."""

    rule: str
    name: str
    """The wildcards, joined by /."""
    steps: Sequence[Step] = ()
    members: Sequence[Unit] = ()
    """The units of a batch."""
    needs: Sequence[Unit] = ()
    """Units of other jobs whose results it reads."""
    made_of: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Step -> settings, options, code and inputs."""
    run: Callable[[Mapping[str, Any]], Sequence[Path]] | None = None
    """For jobs without stages: runs the job, given its device and threads, and returns the written files."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """For jobs without stages: the options of the command."""

    @functools.cached_property
    def digest(self) -> str:
        """Digest of everything that the results depend on."""
        return digest_of([self.made_of, *(member.digest for member in self.members)])


class Graph:
    """The jobs of one benchmark."""

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark, self.config, self.whole = benchmark, benchmark.config, benchmark.whole
        self.results = benchmark.config.results
        self.rules: dict[str, list[Stage]] = defaultdict(list)
        """Rule -> its stages, in the order in which they run."""
        for stage in STAGES.values():
            self.rules[stage.job_rule].append(stage)
        # Thousands of jobs share a few rows.
        self._cached_rows, self._overridden = functools.cache(self._rows), functools.cache(self._override)
        self.unit, self.batches = functools.cache(self._unit), functools.cache(self._batches)
        self.tasks: Mapping[str, Callable[[str], Unit]] = {}
        """Rule without stages -> function from the name of a job to its unit."""
        self._digests: dict[str, str] = {}
        self._texts: dict[Any, str] = {}
        self.owners = {stage.name: self._owners(stage.shared) for stage in STAGES.values() if stage.shared}
        """Stage with shared jobs -> method -> first method of the table with the same job."""

    def _owners(self, shared: Callable[[Config, Method], Any]) -> dict[str, str]:
        first: dict[Any, str] = {}
        keys = {name: shared(self._overridden(name, None), row) for name, row in self.benchmark.table.items()}
        return {name: first.setdefault(key, name) for name, key in keys.items() if key is not None}

    # --- table rows of a step

    def rows(self, job: Any) -> Rows:
        """The table rows that the wildcards of a step name."""
        method = getattr(job, "method", None)
        if looks := getattr(job, "looks", None):
            method = looks.removeprefix(SPLATS_FOLDER).removeprefix("-") or None
        return self._cached_rows(job.scenario, method, getattr(job, "search", None))

    def _rows(self, scenario: str, name: str | None, search: str | None) -> Rows:
        benchmark = self.benchmark
        method = benchmark.table[name] if name else None
        searched = search or (method.searched if method and method.search else None)
        pools = {row.pool for row in benchmark.methods.values() if row.pool and searched == row.searched}
        return Rows(
            config=self._overridden(name, searched),
            scenario=benchmark.scenarios[scenario],
            source=benchmark.source(scenario),
            data=benchmark.data_path(scenario),
            images=benchmark.has_images(scenario),
            method=method,
            search=benchmark.searches[searched] if searched else None,
            pool=benchmark.pools.get(scenario, ()) if pools else (),
            targets=benchmark.transfers.get(scenario, ()),
        )

    def _override(self, name: str | None, searched: str | None) -> Config:
        """The configuration, overridden by the settings of a method and of a search."""
        config = with_method(self.config, self.benchmark.table[name], name) if name else self.config
        return with_search(config, self.benchmark.searches[searched], searched) if searched else config

    def _cameras(self, scenario: str) -> tuple[str, ...]:
        try:
            return self.benchmark.cameras(scenario)
        except InputError:
            # Damaged data must fail only the jobs of their scenario, which report the error, and not the planning.
            return ("0",)

    # --- steps

    def output_of(self, stage: Stage, job: Any) -> str:
        """The output file of a step."""
        return f"{self.results}/{stage.output.format(**{name: getattr(job, name) for name in stage.wildcards})}"

    def makers_of(self, stage: Stage, name: str, job: Any) -> list[Step]:
        """The steps that make the files of a parameter: a single step, or one per camera, recording or seed."""
        rows, parameter = self.rows(job), stage.inputs[name]
        if name in stage.without(rows):
            return []
        if parameter.many and parameter.type is Observations:
            others = [SimpleNamespace(scenario=other) for other in getattr(rows, name)]
            return [Step(maker, other) for maker in makers("observations") for other in others]
        if parameter.many and rows.method and rows.method.mean_of and "seed" in makers(name)[0].wildcards:
            seeds = [SimpleNamespace(scenario=job.scenario, method=rows.method.mean_of, seed=seed) for seed in self.whole.seeds]
            return [Step(maker, other) for other in seeds for maker in makers(name) if maker.when(self.rows(other))]
        if not (existing := [maker for maker in makers(name) if maker.when(rows)]):
            return []
        maker, method = existing[0], getattr(job, "method", None)
        owner = self.owners.get(maker.name, {}).get(method or "")
        values = {
            "scenario": job.scenario,
            "seed": getattr(job, "seed", None),
            "method": owner or method,
            "search": rows.method.searched if rows.method else None,
            "looks": f"{SPLATS_FOLDER}-{owner}" if owner else SPLATS_FOLDER,
        }
        wildcards = {wildcard: values[wildcard] for wildcard in maker.wildcards if wildcard != "camera"}
        if "camera" not in maker.wildcards:
            return [Step(maker, SimpleNamespace(**wildcards))]
        cameras = self._cameras(job.scenario) if parameter.many else [job.camera]
        return [Step(maker, SimpleNamespace(**wildcards, camera=camera)) for camera in cameras]

    def files(self, stage: Stage, name: str, job: Any) -> list[str]:
        """The files of a parameter; empty if the step omits it."""
        rows = self.rows(job)
        if name in stage.without(rows):
            return []
        made = [self.output_of(step.stage, step.job) for step in self.makers_of(stage, name, job)]
        return made or [str(path) for maker in makers(name) if not maker.when(rows) and (path := maker.instead(rows))]

    def options(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The options of a step, by name."""
        rows = self.rows(job)
        given = dict(stage.given(rows))
        for name, option in stage.options.items():
            if option.type is ScenarioRow:
                given[name] = rows.scenario
            elif name not in given:
                # An option without a value in the rows is a wildcard if it is required, else it has the signature's default.
                given[name] = getattr(job, name) if option.required else getattr(job, name, option.default)
        return {name: given[name] for name in stage.options}

    def _given(self, stage: Stage, job: Any) -> dict[str, Any]:
        """Values of the parameters, for `reads` and `code` of a stage: options and input files."""
        return self.options(stage, job) | {name: self.files(stage, name, job) for name in stage.inputs}

    def made_of(self, stage: Stage, job: Any) -> dict[str, Any]:
        """Everything that the result of a step depends on, independent of the folders of results and data."""
        rows, given = self.rows(job), self._given(stage, job)
        # Thousands of steps share a few texts, because settings depend only on the source and the row.
        key = (stage.name, rows.scenario.source, *(getattr(job, name, None) for name in ("method", "search", "looks")))
        if key not in self._texts:
            read = stage.settings(stage.settled(rows), given)
            read.pop("data_root", None)
            self._texts[key] = json.dumps(read, sort_keys=True)
        inputs: dict[str, str] = {}
        for name in stage.inputs:
            made = [self.digest(step.stage, step.job) for step in self.makers_of(stage, name, job)]
            stamps = made or [_stamp(path) for path in given[name]]
            inputs |= {f"{name}{index}" if stage.inputs[name].many else name: stamp for index, stamp in enumerate(stamps)}
        return {
            "settings": self._texts[key],
            "options": {
                name: plain(value) if isinstance(value, ScenarioRow) else value for name, value in self.options(stage, job).items()
            },
            "code": stage.code_of(stage.settled(rows), given),
            "inputs": inputs,
            "data": self.data(stage, job),
        }

    def data(self, stage: Stage, job: Any) -> dict[str, str]:
        """Stamps of the user's files and images that a step reads in addition to its inputs."""
        rows = self.rows(job)
        files = {Path(path).name: _stamp(path) for path in stage.also(rows)}
        own_capture = "capture" in stage.inputs and not self.makers_of(stage, "capture", job)
        stamps = {"stamp": stage.stamp(rows), "images": rows.image_stamps if own_capture else ""}
        return files | {name: stamp for name, stamp in stamps.items() if stamp}

    def digest(self, stage: Stage, job: Any) -> str:
        """Digest of everything that the result of a step depends on."""
        output = self.output_of(stage, job)
        if output not in self._digests:
            self._digests[output] = digest_of(self.made_of(stage, job))
        return self._digests[output]

    def job(self, step: Step, **places: Any) -> Job:
        """The `Job` of a step, ready to run."""
        stage, files = step.stage, {name: self.files(step.stage, name, step.job) for name in step.stage.inputs}
        given: dict[str, Any] = {n: f if stage.inputs[n].many else f[0] if f else None for n, f in files.items()}
        settings = stage.settled(self.rows(step.job)) if "settings" in stage.signature else None
        given |= {name: places[name] for name in stage.places}
        output = Path(self.output_of(stage, step.job))
        output.parent.mkdir(parents=True, exist_ok=True)
        made = stage.job(output=output, settings=settings, **given, **self.options(stage, step.job))
        if data := self.data(stage, step.job):
            made.record.inputs["data"] = digest_of(data)
        return made

    # --- units

    def wildcards(self, rule: str) -> list[str]:
        """The wildcards of a unit's name."""
        return [name for name in self.rules[rule][0].wildcards if name != "camera"]

    def _unit(self, rule: str, name: str) -> Unit:
        """The unit of a rule with this name. Raises InputError if it does not exist."""
        if rule in self.tasks:
            return self.tasks[rule](name)
        parts, names = name.split("/"), self.wildcards(rule)
        if parts[0] == BATCH:
            return self.batches(rule)[int(parts[1])]
        if len(parts) != len(names) or parts[0] not in self.benchmark.scenarios:
            raise InputError(f"{rule} {name}", f"must have the form {'/'.join(names)}, with names of this configuration")
        values: dict[str, Any] = dict(zip(names, parts, strict=True))
        values |= {"seed": int(values["seed"])} if "seed" in values else {}
        job, steps = SimpleNamespace(**values), list[Step]()
        for stage in self.rules[rule]:
            if stage.when(self.rows(job)):
                cameras = self._cameras(job.scenario) if "camera" in stage.wildcards else [None]
                steps += [Step(stage, SimpleNamespace(**values, **({"camera": camera} if camera else {}))) for camera in cameras]
        needs = dict[str, Unit]()
        for step in steps:
            for parameter in step.stage.inputs:
                for other in self.makers_of(step.stage, parameter, step.job):
                    key = self._name(other)
                    if key != (rule, name):
                        needs["/".join(key)] = self.unit(*key)
        made_of = {
            "/".join(filter(None, (s.stage.name, getattr(s.job, "camera", "")))): self.made_of(s.stage, s.job) for s in steps
        }
        return Unit(rule=rule, name=name, steps=steps, needs=list(needs.values()), made_of=made_of)

    def _name(self, step: Step) -> tuple[str, str]:
        rule = step.stage.job_rule
        return rule, "/".join(str(getattr(step.job, name)) for name in self.wildcards(rule))

    def runs(self, methods: Collection[str] | None = None) -> list[Unit]:
        """The runs of the configuration, of all methods or of the given ones."""
        return [
            self.unit("run", f"{scenario}/{method}/{seed}")
            for scenario in self.config.scenarios
            for method in (self.config.methods if methods is None else methods)
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    def judged(self, names: Sequence[str]) -> dict[str, str]:
        """Scenario with known truth -> its category."""
        benchmark = self.benchmark
        return {name: benchmark.whole_scenarios[name].category for name in names if benchmark.source(name).has_truth}

    def earliness(self, unit: Unit) -> float:
        """Priority by scenario: 1 for the first scenario, decreasing to 0."""
        names = self.config.scenarios
        scenario = (unit.members[0] if unit.members else unit).name.partition("/")[0]
        return 1 - names.index(scenario) / len(names) if scenario in names else 0.0

    def gpus(self, unit: Unit) -> int:
        """Number of GPUs of its job: 1 if one of its stages uses a GPU and jobs run on GPUs, else 0."""
        uses_gpu = False
        for member in unit.members or (unit,):
            for stage, job in ((step.stage, step.job) for step in member.steps):
                uses_gpu |= stage.gpu(stage.settled(self.rows(job))) if callable(stage.gpu) else stage.gpu
        return int(self.benchmark.on_gpu and uses_gpu)

    # --- batches: units that share launches

    def _batches(self, rule: str) -> list[Unit]:
        """The batches of a rule over the units of all runs; empty if `twins_per_launch` is 1."""
        stage = self.rules[rule][0]
        if stage.many is None or self.config.twins_per_launch == 1:
            return []
        alike: dict[Any, dict[str, Unit]] = defaultdict(dict)
        for unit in [needed for run in self.runs() for needed in behind(run) if needed.rule == rule]:
            assert stage.alike
            if (key := stage.alike(self.rows(unit.steps[0].job))) is not None:
                alike[key].setdefault(unit.name, unit)
        batches: list[list[Unit]] = []
        of_scenarios: dict[str, list[Unit]] = defaultdict(list)
        for units in (list(group.values()) for group in alike.values()):
            if (most := self._most(len(units))) > 1:
                parts, total = -(-len(units) // most), len(units)
                # All batches have about the same size.
                batches += [units[total * part // parts : total * (part + 1) // parts] for part in range(parts)]
            elif stage.least_on_cpu:
                counts = Counter(unit.name.partition("/")[0] for unit in units)
                for unit in units:
                    scenario = unit.name.partition("/")[0]
                    of_scenarios[scenario] += [unit] * (counts[scenario] >= stage.least_on_cpu)
        batches += of_scenarios.values()
        return [
            Unit(
                rule=rule,
                name=f"{BATCH}/{index}",
                members=members,
                needs=list({id(n): n for m in members for n in m.needs}.values()),
            )
            for index, members in enumerate(batch for batch in batches if len(batch) > 1)
        ]

    def _most(self, units: int) -> int:
        """Maximum size of a batch for this number of units that can share launches."""
        if self.config.gpus.batch != "auto":
            return self.config.gpus.batch
        slots = self.benchmark.gpu_slots
        return 1 if not self.benchmark.on_gpu else min(LARGEST_BATCH, -(-units // slots) if slots else LARGEST_BATCH)

    # --- records of finished units

    def folder(self, unit: Unit) -> Path:
        """The folder of its job's records."""
        return Path(self.results) / FOLDER / unit.rule / unit.name

    def record(self, unit: Unit) -> Path:
        """The path of its record, which exists if the unit is finished."""
        return self.folder(unit) / f"{unit.digest}.json"

    def finished(self, unit: Unit) -> bool:
        """True if its record and its results exist; a record without its results is deleted."""
        path = self.record(unit)
        try:
            record = JobRecord.load(path) if path.exists() else None
        except InputError:
            record = None
        if record and all((Path(self.results) / name).exists() for name in record.files):
            return True
        path.unlink(missing_ok=True)
        return False

    def job_of(self, unit: Unit) -> Unit:
        """The job that makes a unit: its batch while the unit is not finished, else the unit itself."""
        if unit.rule in self.rules and self.rules[unit.rule][0].many and not self.finished(unit):
            return next((batch for batch in self.batches(unit.rule) if unit in batch.members), unit)
        return unit

    def todo(self, targets: Sequence[Unit]) -> list[Unit]:
        """The unfinished jobs that the targets require, including themselves."""
        jobs: dict[int, Unit] = {}
        waiting = [self.job_of(unit) for unit in targets]
        while waiting:
            job = waiting.pop()
            if id(job) not in jobs and not self.finished(job):
                jobs[id(job)] = job
                waiting += [self.job_of(other) for other in job.needs]
        return list(jobs.values())


def behind(unit: Unit, known: set[int] | None = None) -> Iterator[Unit]:
    """Yield all units that a unit requires, directly or indirectly, each once."""
    known = set() if known is None else known
    for needed in unit.needs:
        if id(needed) not in known:
            known.add(id(needed))
            yield from behind(needed, known)
            yield needed


@functools.cache
def _stamp(path: Any) -> str:
    return file_stamp(Path(path)) if Path(path).is_file() else ""


def digest_of(values: Any) -> str:
    """A short SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
