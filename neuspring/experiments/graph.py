"""The jobs of a benchmark: which steps a job runs, what they read, and what their results follow from.

A stage declares what it reads and what of the tables concerns it (`neuspring.stages.stage`). A `Unit` is a job, or a member of a
batch: the stages of one rule with the same wildcards. Its digest is that of the settings, code and inputs of its steps, where an
input that is made by another step counts with the digest of that step. The record of a finished unit has the digest in its name.
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
"""Folder of the splats that all methods share; those of one method have its name behind a hyphen."""
BATCH = "together"
"""First part of the name of a batch."""
LARGEST_BATCH = 16
"""Units of a batch on a GPU at most, where `gpus.batch` is auto. It was not measured with several scenes."""


@dataclass(frozen=True)
class Step:
    """One call of a stage."""

    stage: Stage
    job: Any
    """An object with its wildcards."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Unit:
    """A job, or a member of a batch."""

    rule: str
    name: str
    """Its wildcards, joined by /."""
    steps: Sequence[Step] = ()
    members: Sequence[Unit] = ()
    """The units of a batch."""
    needs: Sequence[Unit] = ()
    """Units of other jobs whose results it reads."""
    made_of: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Step -> settings, options, code and inputs."""
    run: Callable[[Mapping[str, Any]], Sequence[Path]] | None = None
    """Runs a job that is no stage's, given its device and threads; returns the files that it wrote."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of a command that is no stage's."""

    @functools.cached_property
    def digest(self) -> str:
        """Of everything that its results follow from."""
        return digest_of([self.made_of, *(one.digest for one in self.members)])


class Graph:
    """Answers for the jobs of one benchmark."""

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark, self.config, self.whole = benchmark, benchmark.config, benchmark.whole
        self.results = benchmark.config.results
        self.rules: dict[str, list[Stage]] = defaultdict(list)
        """Rule -> its stages, in the order in which they run."""
        for stage in STAGES.values():
            self.rules[stage.job_rule].append(stage)
        # Thousands of jobs share a few rows.
        self._of, self._laid = functools.cache(self._rows), functools.cache(self._lay)
        self.unit, self.batches = functools.cache(self._unit), functools.cache(self._batches)
        self.tasks: Mapping[str, Callable[[str], Unit]] = {}
        """Rule that is no stage's -> the name of a job -> its unit."""
        self._digests: dict[str, str] = {}
        self._texts: dict[Any, str] = {}
        self.owners = {one.name: self._owners(one.shared) for one in STAGES.values() if one.shared}
        """Stage whose jobs methods share -> method -> the first row of the method table with the same job."""

    def _owners(self, shared: Callable[[Config, Method], Any]) -> dict[str, str]:
        first: dict[Any, str] = {}
        keys = {name: shared(self._laid(name, None), row) for name, row in self.benchmark.table.items()}
        return {name: first.setdefault(key, name) for name, key in keys.items() if key is not None}

    # --- the rows behind a step

    def rows(self, job: Any) -> Rows:
        """The rows of the tables that the wildcards of a step name."""
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
            targets=known.transfers.get(scenario, ()),
        )

    def _lay(self, name: str | None, searched: str | None) -> Config:
        """The configuration with the settings of a method and of a search on top."""
        config = with_method(self.config, self.benchmark.table[name], name) if name else self.config
        return with_search(config, self.benchmark.searches[searched], searched) if searched else config

    def _cameras(self, scenario: str) -> tuple[str, ...]:
        try:
            return self.benchmark.cameras(scenario)
        except InputError:
            # Damaged data must fail the jobs of their scenario, which say what is wrong, and not the planning of all.
            return ("0",)

    # --- steps

    def output_of(self, stage: Stage, job: Any) -> str:
        """The file that a step writes."""
        return f"{self.results}/{stage.output.format(**{name: getattr(job, name) for name in stage.wildcards})}"

    def makers_of(self, stage: Stage, name: str, job: Any) -> list[Step]:
        """The steps that make the files of a parameter: one of its maker, or one of each camera, recording or seed."""
        rows, parameter = self.rows(job), stage.inputs[name]
        if name in stage.without(rows):
            return []
        if parameter.many and parameter.type is Observations:
            others = [SimpleNamespace(scenario=other) for other in getattr(rows, name)]
            return [Step(one, other) for one in makers("observations") for other in others]
        if parameter.many and rows.method and rows.method.mean_of and "seed" in makers(name)[0].wildcards:
            seeds = [SimpleNamespace(scenario=job.scenario, method=rows.method.mean_of, seed=seed) for seed in self.whole.seeds]
            return [Step(one, other) for other in seeds for one in makers(name) if one.when(self.rows(other))]
        if not (found := [one for one in makers(name) if one.when(rows)]):
            return []
        maker, method = found[0], getattr(job, "method", None)
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
        """The files of a parameter; none where a step goes without."""
        rows = self.rows(job)
        if name in stage.without(rows):
            return []
        made = [self.output_of(one.stage, one.job) for one in self.makers_of(stage, name, job)]
        return made or [str(path) for maker in makers(name) if not maker.when(rows) and (path := maker.instead(rows))]

    def options(self, stage: Stage, job: Any) -> dict[str, Any]:
        """The options of a step, by name."""
        rows = self.rows(job)
        given = dict(stage.given(rows))
        for name, option in stage.options.items():
            if option.type is ScenarioRow:
                given[name] = rows.scenario
            elif name not in given:
                # What rows do not tell has the default of the signature; a required one is a wildcard.
                given[name] = getattr(job, name) if option.required else getattr(job, name, option.default)
        return {name: given[name] for name in stage.options}

    def _given(self, stage: Stage, job: Any) -> dict[str, Any]:
        """Values of parameters that `reads` and `code` of a stage ask for: options, and which inputs there are."""
        return self.options(stage, job) | {name: self.files(stage, name, job) for name in stage.inputs}

    def made_of(self, stage: Stage, job: Any) -> dict[str, Any]:
        """What the result of a step follows from, wherever results and data lie."""
        rows, given = self.rows(job), self._given(stage, job)
        # Thousands of steps share a few texts: those of one source and one row.
        key = (stage.name, rows.scenario.source, *(getattr(job, name, None) for name in ("method", "search", "looks")))
        if key not in self._texts:
            read = stage.settings(stage.settled(rows), given)
            read.pop("data_root", None)
            self._texts[key] = json.dumps(read, sort_keys=True)
        inputs: dict[str, str] = {}
        for name in stage.inputs:
            made = [self.digest(one.stage, one.job) for one in self.makers_of(stage, name, job)]
            stamps = made or [_stamp(path) for path in given[name]]
            inputs |= {f"{name}{place}" if stage.inputs[name].many else name: stamp for place, stamp in enumerate(stamps)}
        return {
            "settings": self._texts[key],
            "options": {
                name: plain(one) if isinstance(one, ScenarioRow) else one for name, one in self.options(stage, job).items()
            },
            "code": stage.code_of(stage.settled(rows), given),
            "inputs": inputs,
            "data": self.data(stage, job),
        }

    def data(self, stage: Stage, job: Any) -> dict[str, str]:
        """Stamps of the user's files and images that a step reads beside its inputs."""
        rows = self.rows(job)
        found = {Path(path).name: _stamp(path) for path in stage.also(rows)}
        own = "capture" in stage.inputs and not self.makers_of(stage, "capture", job)
        stamps = {"stamp": stage.stamp(rows), "images": rows.image_stamps if own else ""}
        return found | {name: stamp for name, stamp in stamps.items() if stamp}

    def digest(self, stage: Stage, job: Any) -> str:
        """Of everything that the result of a step follows from."""
        output = self.output_of(stage, job)
        if output not in self._digests:
            self._digests[output] = digest_of(self.made_of(stage, job))
        return self._digests[output]

    def job(self, step: Step, **places: Any) -> Job:
        """A step, ready to run."""
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
        """The names in a unit's name."""
        return [name for name in self.rules[rule][0].wildcards if name != "camera"]

    def _unit(self, rule: str, name: str) -> Unit:
        """The unit of a rule with this name. Raises InputError if there is no such one."""
        if rule in self.tasks:
            return self.tasks[rule](name)
        parts, names = name.split("/"), self.wildcards(rule)
        if parts[0] == BATCH:
            return self.batches(rule)[int(parts[1])]
        if len(parts) != len(names) or parts[0] not in self.benchmark.scenarios:
            raise InputError(f"{rule} {name}", f"must be {'/'.join(names)} of this configuration")
        values: dict[str, Any] = dict(zip(names, parts, strict=True))
        values |= {"seed": int(values["seed"])} if "seed" in values else {}
        job, steps = SimpleNamespace(**values), list[Step]()
        for stage in self.rules[rule]:
            if stage.when(self.rows(job)):
                cameras = self._cameras(job.scenario) if "camera" in stage.wildcards else [None]
                steps += [Step(stage, SimpleNamespace(**values, **({"camera": one} if one else {}))) for one in cameras]
        needs = dict[str, Unit]()
        for step in steps:
            for name_of in step.stage.inputs:
                for other in self.makers_of(step.stage, name_of, step.job):
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
        """The runs of the configuration, or of some of its methods."""
        return [
            self.unit("run", f"{scenario}/{method}/{seed}")
            for scenario in self.config.scenarios
            for method in (self.config.methods if methods is None else methods)
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    def judged(self, names: Sequence[str]) -> dict[str, str]:
        """Scenarios whose truth is known, and their categories."""
        known = self.benchmark
        return {name: known.whole_scenarios[name].category for name in names if known.source(name).has_truth}

    def earliness(self, unit: Unit) -> float:
        """From 1 for units of the first scenario that is run down to 0."""
        names = self.config.scenarios
        scenario = (unit.members[0] if unit.members else unit).name.partition("/")[0]
        return 1 - names.index(scenario) / len(names) if scenario in names else 0.0

    def gpus(self, unit: Unit) -> int:
        """GPUs that its job takes: 1 where one of its stages uses one and there are any."""
        wanted = False
        for one in unit.members or (unit,):
            for stage, job in ((step.stage, step.job) for step in one.steps):
                wanted |= stage.gpu(stage.settled(self.rows(job))) if callable(stage.gpu) else stage.gpu
        return int(self.benchmark.on_gpu and wanted)

    # --- batches: units that share launches

    def _batches(self, rule: str) -> list[Unit]:
        """The batches of a rule, of the units of all runs; none where `twins_per_launch` is 1."""
        stage = self.rules[rule][0]
        if stage.many is None or self.config.twins_per_launch == 1:
            return []
        alike: dict[Any, dict[str, Unit]] = defaultdict(dict)
        for unit in [one for run in self.runs() for one in behind(run) if one.rule == rule]:
            assert stage.alike
            if (key := stage.alike(self.rows(unit.steps[0].job))) is not None:
                alike[key].setdefault(unit.name, unit)
        batches: list[list[Unit]] = []
        of_scenarios: dict[str, list[Unit]] = defaultdict(list)
        for units in (list(found.values()) for found in alike.values()):
            if (most := self._most(len(units))) > 1:
                parts, total = -(-len(units) // most), len(units)
                # As large as one another.
                batches += [units[total * part // parts : total * (part + 1) // parts] for part in range(parts)]
            elif stage.least_on_cpu:
                counts = Counter(one.name.partition("/")[0] for one in units)
                for one in units:
                    of_scenarios[one.name.partition("/")[0]] += [one] * (counts[one.name.partition("/")[0]] >= stage.least_on_cpu)
        batches += of_scenarios.values()
        return [
            Unit(
                rule=rule,
                name=f"{BATCH}/{place}",
                members=members,
                needs=list({id(n): n for m in members for n in m.needs}.values()),
            )
            for place, members in enumerate(batch for batch in batches if len(batch) > 1)
        ]

    def _most(self, units: int) -> int:
        """Units of a batch at most, of so many that are alike."""
        if self.config.gpus.batch != "auto":
            return self.config.gpus.batch
        slots = self.benchmark.gpu_slots
        return 1 if not self.benchmark.on_gpu else min(LARGEST_BATCH, -(-units // slots) if slots else LARGEST_BATCH)

    # --- records of finished units

    def folder(self, unit: Unit) -> Path:
        """The folder of its job's records."""
        return Path(self.results) / FOLDER / unit.rule / unit.name

    def record(self, unit: Unit) -> Path:
        """The record that says that it is finished."""
        return self.folder(unit) / f"{unit.digest}.json"

    def finished(self, unit: Unit) -> bool:
        """True where its record is there and its results are too; a record without them is deleted."""
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
        """The job that makes a unit: its batch while it is not finished, else itself."""
        if unit.rule in self.rules and self.rules[unit.rule][0].many and not self.finished(unit):
            return next((batch for batch in self.batches(unit.rule) if unit in batch.members), unit)
        return unit

    def todo(self, targets: Sequence[Unit]) -> list[Unit]:
        """The jobs behind targets that are not finished."""
        found: dict[int, Unit] = {}
        waiting = [self.job_of(one) for one in targets]
        while waiting:
            one = waiting.pop()
            if id(one) not in found and not self.finished(one):
                found[id(one)] = one
                waiting += [self.job_of(other) for other in one.needs]
        return list(found.values())


def behind(unit: Unit, known: set[int] | None = None) -> Iterator[Unit]:
    """The units behind a unit, each once."""
    known = set() if known is None else known
    for one in unit.needs:
        if id(one) not in known:
            known.add(id(one))
            yield from behind(one, known)
            yield one


@functools.cache
def _stamp(path: Any) -> str:
    return file_stamp(Path(path)) if Path(path).is_file() else ""


def digest_of(values: Any) -> str:
    """A digest of values that JSON can hold."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
