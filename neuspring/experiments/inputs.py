"""What the rules of the workflow ask about one job: its files, its settings, its code.

Rules declare and call; everything that depends on the configuration is answered here, from the wildcards of a job.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from neuspring.baselines import BASELINES
from neuspring.config import Method, plain
from neuspring.config.images import Appearance
from neuspring.config.select import select
from neuspring.core.errors import InputError
from neuspring.core.provenance import code_digest
from neuspring.data.sources import SOURCES
from neuspring.experiments import benchmark as benchmarks
from neuspring.experiments.benchmark import Benchmark
from neuspring.perception.backends import BACKENDS, backend_keys
from neuspring.scores.lpips_weights import configured
from neuspring.stages import STAGES

SPLATS = "appearance"
"""Folder of the splats that all methods share; those of one method have its name behind a hyphen."""
REGIONS_ONLY = ("tied_rollouts", "freed_sigma")
"""Settings of the search that concern nothing where there is one region."""


def one_of(names: Sequence[str]) -> str:
    """A pattern of exactly these names; of none, one that matches nothing."""
    return "|".join(map(re.escape, names)) or "(?!)"


class Inputs:
    """Answers for the jobs of one benchmark."""

    def __init__(self, benchmark: Benchmark) -> None:
        self.benchmark, self.config = benchmark, benchmark.config
        self.results = benchmark.config.results

    # --- which jobs there are

    def scenarios(self, *, truth: bool = False, imported: bool = False) -> str:
        """Pattern of the scenarios whose captures are made with their truth, or imported."""
        names = [
            name
            for name in self.benchmark.scenarios
            if (source := self.benchmark.source(name)).write_capture
            and (source.has_truth if truth else imported and not source.has_truth)
        ]
        return one_of(names)

    def methods(self, *, model: bool, trained: bool = False) -> str:
        """Pattern of the methods with a baseline's model (that is trained), or with a search."""
        rows = self.benchmark.methods.items()
        if not model:
            return one_of([name for name, row in rows if row.search])
        return one_of([name for name, row in rows if row.model and (BASELINES[row.model].trained or not trained)])

    @property
    def splat_folders(self) -> str:
        """Pattern of the folders of splats."""
        return one_of([SPLATS, *(f"{SPLATS}-{name}" for name in self.benchmark.splats)])

    def judged(self, names: Sequence[str]) -> dict[str, str]:
        """Scenarios whose truth is known, and their categories."""
        rows = self.benchmark.whole_scenarios
        return {name: rows[name].category for name in names if SOURCES[rows[name].source].has_truth}

    def runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """The records of all runs, or of those of some methods."""
        return [
            f"{self.results}/{scenario}/{method}/{seed}/run.json"
            for scenario in self.config.scenarios
            for method in (self.config.methods if methods is None else methods)
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    def logged_runs(self, methods: Sequence[str] | None = None) -> list[str]:
        """Files that say that a run is in MLflow; none where tracking is off."""
        return [path.replace("run.json", "mlflow.txt") for path in self.runs(methods) if self.config.tracking.enabled]

    def transfers(self) -> list[str]:
        """Records of transfers: per source, method and seed.

        Oracles concern the future of the same recording, so they are not transferred.
        """
        methods = [
            name
            for name, method in self.benchmark.methods.items()
            if (method.search or (method.model and BASELINES[method.model].transfers)) and not method.oracle
        ]
        return [
            f"{self.results}/{scenario}/{method}/{seed}/transfer.json"
            for scenario in self.benchmark.transfers
            for method in methods
            if self.benchmark.applies(method, scenario)
            for seed in self.config.seeds
        ]

    # --- captures and perception

    def row(self, job: Any) -> str:
        """The scenario's row, as JSON."""
        return _json(plain(self.benchmark.scenarios[job.scenario]))

    def films(self, job: Any) -> bool:
        """Whether perception makes the observations."""
        return self.benchmark.source(job.scenario).films

    def capture(self, job: Any) -> str:
        """capture.json: the user's own, or one that the workflow makes."""
        return f"{self.benchmark.capture_folder(job.scenario)}/capture.json"

    def imported_files(self, job: Any) -> list[str]:
        """What a capture is imported from, so that changed data are read again."""
        folder = self.benchmark.data_path(job.scenario)
        names = self.benchmark.source(job.scenario).capture_files
        return [str(folder / name) for name in names if folder and (folder / name).exists()]

    def image_stamps(self, job: Any) -> str:
        """A digest of names, sizes and times of the images that the user may change, so that changed ones are read again."""
        folder, source = self.benchmark.data_path(job.scenario), self.benchmark.source(job.scenario)
        return _stamps(folder) if folder and (source.films or source.capture_files) else ""

    def of_cameras(self, job: Any, name: str) -> list[str]:
        """A file of every camera."""
        try:
            cameras = self.benchmark.cameras(job.scenario)
        except InputError:
            # Damaged data must fail the jobs of their scenario, which say what is wrong, and not the planning of all.
            cameras = ("0",)
        return [f"{self.results}/{job.scenario}/perception/{camera}/{name}" for camera in cameras]

    def truth(self, step: str) -> list[str] | str:
        """The truth of a synthetic scene, if the step's backend reads it."""
        name = getattr(self.config.perception, step).backend
        reads = BACKENDS[step][name].truth if step in BACKENDS else name == "truth"
        return f"{self.results}/{{scenario}}/capture_truth.npz" if reads else []

    def backend(self, step: str, job: Any) -> str:
        """The backend of a step. Processed data have masks; those are taken, whatever segments raw video."""
        if step == "segment" and not self.films(job):
            return "given"
        return str(getattr(self.config.perception, step).backend)

    def observed_from(self, job: Any) -> list[str]:
        """What observations are made of."""
        if self.films(job):
            return [self.capture(job), self.lifted(job)]
        path = self.benchmark.data_path(job.scenario)
        if path is None:
            return []
        if path.is_file():
            return [str(path)]
        return [str(path / name) for name in self.benchmark.source(job.scenario).files if (path / name).exists()]

    def lifted(self, job: Any) -> str:
        """The record of perception."""
        return f"{self.results}/{job.scenario}/perception/lifted.json"

    def first_points(self, job: Any) -> str:
        """Where the first splats lie: perception's record, or the observations of processed data."""
        return self.lifted(job) if self.films(job) else f"{self.results}/{job.scenario}/observations.npz"

    # --- stages of a run

    def _record(self, job: Any, folder: str, name: str) -> str:
        return f"{self.results}/{job.scenario}/{folder}/{job.seed}/{name}.json"

    def search_of_fit(self, job: Any) -> str:
        """The search that a method starts from."""
        method = (self.benchmark.methods | self.benchmark.fits)[job.method]
        return self._record(job, f"search-{method.searched}", "search")

    def pool(self, job: Any) -> list[str]:
        """Observations of the other recordings that a search or a fit is judged on."""
        others = self.benchmark.pools[job.scenario] if self.benchmark.pool_kind(job) else ()
        return [f"{self.results}/{name}/observations.npz" for name in others]

    def pool_options(self, job: Any) -> str:
        """The options of `neuspring search` and `fit` that name them."""
        kind = self.benchmark.pool_kind(job)
        return shlex.join(["--pool", *self.pool(job), *(["--leave-out"] if kind == "others" else [])]) if kind else ""

    def search(self, job: Any) -> list[str]:
        """The search's record; a baseline's model has none."""
        return [] if self.benchmark.methods[job.method].model else [self.search_of_fit(job)]

    def searches_of_fits(self, job: Any) -> list[str]:
        """The searches that the fits of a scenario start from, where these share launches."""
        return list(dict.fromkeys(self.search_of_fit(member) for member in self._members(job.scenario)))

    def rows_of_fits(self, job: Any) -> str:
        """The fits of a scenario that share launches, by row of the method table, as JSON."""
        source = self.benchmark.scenarios[job.scenario].source
        rows: dict[str, dict[str, Any]] = {}
        for member in self._members(job.scenario):
            name = member.method
            row: dict[str, Any] = {
                "kind": self.benchmark.fits[name].fit,
                "settings": self._settings("fit", source, name),
                "fits": {},
            } | ({"oracle": True} if self.benchmark.fits[name].oracle else {})
            rows.setdefault(name, row)["fits"][self._record(member, name, "fit")] = self.search_of_fit(member)
        return _json(list(rows.values()))

    def shared_launches(self, job: Any) -> list[str]:
        """The record of the launches that a fit shared with others, if it is one of several."""
        together = (job.method, int(job.seed)) in self.benchmark.fits_together(job.scenario)
        return [f"{self.results}/{job.scenario}/fits.json"] if together else []

    def _members(self, scenario: str) -> list[Any]:
        pairs = self.benchmark.fits_together(scenario)
        return [SimpleNamespace(scenario=scenario, method=method, seed=seed) for method, seed in pairs]

    def fit(self, job: Any) -> list[str]:
        """The fit's record, if the method has that stage. Methods with the same fit share it."""
        owner = self.benchmark.fit_of_method.get(job.method)
        return [self._record(job, owner, "fit")] if owner else []

    def train(self, job: Any) -> list[str]:
        """The record of the training, for models that have one."""
        model = self.benchmark.methods[job.method].model
        return [self._record(job, job.method, "train")] if model and BASELINES[model].trained else []

    def learned(self, job: Any) -> str:
        """The record that names what was learned: train.json, else fit.json, else search.json."""
        return (self.train(job) or self.fit(job) or self.search(job))[0]

    def appearance(self, job: Any) -> list[str]:
        """The record of the splats, for scenarios with images."""
        if not self.benchmark.has_images(job.scenario):
            return []
        owner = self.benchmark.splats_of_method.get(job.method)
        return [self._record(job, f"{SPLATS}-{owner}" if owner else SPLATS, "appearance")]

    def render(self, job: Any) -> list[str]:
        """The record of the pictures, for scenarios with images."""
        return [self._record(job, job.method, "render")] if self.benchmark.has_images(job.scenario) else []

    def pictured(self, job: Any) -> bool:
        """Whether the method is trained on pictures, and moves splats itself."""
        return job.method in self.benchmark.pictured

    def targets(self, job: Any) -> list[str]:
        """Observations that a model is transferred to."""
        return [f"{self.results}/{target}/observations.npz" for target in self.benchmark.transfers[job.scenario]]

    def variant(self, job: Any) -> str:
        """The switches of a method, for its record."""
        method = self.benchmark.methods[job.method]
        settings = plain(method)["settings"]
        if method.model:
            return _json({"model": method.model, **settings})
        assert method.search
        switches = {
            "search": method.search,
            "clusters": self.benchmark.searches[method.searched].clusters,
            "fit": method.fit or "none",
        }
        if method.pool:
            switches["pool"] = method.pool
        if method.oracle:
            # Named only where it is one, so that other runs' records stay as they were.
            switches["oracle"] = True
        quirks = self.benchmark.searches[method.searched].released_quirks
        on = {"released_quirks": sorted(key for key, value in quirks.items() if value)} if quirks else {}
        return _json(switches | on | settings)

    # --- settings and code

    def settings(self, stage: str, job: Any) -> str:
        """The settings that a stage reads, as JSON, so that changing another one runs nothing again."""
        # Thousands of jobs share a few texts: those of one source and one row.
        source = self.benchmark.scenarios[job.scenario].source
        own = {"search": "search", "fit": "method", "train": "method", "appearance": "looks"}.get(stage)
        return self._settings(stage, source, getattr(job, own) if own else "")

    @functools.cache  # noqa: B019 - one benchmark a process
    def _settings(self, stage: str, source: str, name: str) -> str:
        config = self.config
        declared = SOURCES[source]
        if stage in ("segment", "track"):
            backend = self.backend(stage, SimpleNamespace(scenario=self._example(source)))
            if backend != getattr(config.perception, stage).backend:
                return _json({"perception": {stage: {"backend": backend}}})
            return _json(select(config, (*backend_keys(stage, backend), *STAGES[stage].reads)))
        if stage == "capture":
            return _json(select(config, declared.reads))
        if stage == "observe":
            return _json(select(config, ("perception.sample", "perception.seed") if declared.films else declared.reads))
        if stage == "train":
            return self._training_settings(name)
        values = select(config, STAGES[stage].reads)
        if stage == "search":
            row = self.benchmark.searches[name]
            values["search"] = plain(benchmarks.search_of(config, row, name))
            values["released_quirks"] = plain(benchmarks.quirks_of(config, row, name))
            values["losses"] = plain(benchmarks.losses_of(config, row, name))
            if row.clusters == 1:
                # What concerns regions alone changes nothing here, so it must not start the search again.
                values["search"] = {key: value for key, value in values["search"].items() if key not in REGIONS_ONLY}
        if stage == "fit":
            method = self.benchmark.fits[name]
            values["fit"] = plain(benchmarks.fit_of(config, method, name))
            search = method.searched
            row = self.benchmark.searches[search]
            values["released_quirks"] = plain(benchmarks.quirks_of(config, row, search))
            values["losses"] = plain(benchmarks.losses_of(config, row, search))
            if method.fit == "springs":
                del values["fit"]["field"]
        if stage == "appearance":
            values["images"]["appearance"] = plain(self.splat_settings(name))
            if not declared.films:
                # Perception has not lifted the masks of processed data.
                values |= select(config, ("perception.lift",))
        return _json(values)

    def _example(self, source: str) -> str:
        return next(name for name, row in self.benchmark.scenarios.items() if row.source == source)

    def _training_settings(self, name: str) -> str:
        """A model's section, with the method's own settings on top, and what else its training reads."""
        method = self.benchmark.methods[name]
        baseline = BASELINES[method.model or ""]
        section = benchmarks.section_of(self.config, method, name)
        values = select(self.config, baseline.reads(section))
        return _json(values | {"baselines": {baseline.section: plain(section)}})

    def splat_settings(self, folder: str) -> Appearance:
        """How the splats of a folder are trained: those of all methods, or a method's own."""
        name = folder.removeprefix(f"{SPLATS}-")
        if name == SPLATS:
            return self.config.images.appearance
        return benchmarks.appearance_of(self.config, self.benchmark.splats[name], name)

    def code(self, stage: str, job: Any) -> str:
        """A digest of the code that a stage uses, so that editing it runs the stage again."""
        return code_digest(f"neuspring.stages.{stage}", *self._modules(stage, job))

    def _modules(self, stage: str, job: Any) -> tuple[str, ...]:
        """Modules that a stage imports by name."""
        if stage in BACKENDS:
            return (BACKENDS[stage][self.backend(stage, job)].module,)
        source = self.benchmark.source(job.scenario)
        if stage == "capture":
            return (source.importer,)
        if stage == "observe":
            return () if source.films else (source.module,)
        method: Method | None = self.benchmark.methods.get(getattr(job, "method", ""))
        if stage in ("train", "predict", "transfer") and method and method.model:
            return BASELINES[method.model].modules
        return ()

    def gpu(self, stage: str, job: Any) -> bool:
        """Whether a job of a stage takes a GPU where there is one."""
        declared = STAGES[stage].gpu
        return declared == "always" or (declared == "backend" and BACKENDS[stage][self.backend(stage, job)].gpu)

    def features(self, job: Any) -> str:
        """Whether optional weights of a baseline are there, so that weights that come later are used."""
        if not self.pictured(job):
            return "none"
        method = self.benchmark.methods[job.method]
        return BASELINES[method.model or ""].features(benchmarks.section_of(self.config, method, job.method))

    def lpips(self) -> str:
        """Whether LPIPS can be computed, so that weights that come later are used."""
        return "absent" if isinstance(configured(self.config.images.lpips), str) else "found"


def options(files: Mapping[str, Any], **names: str) -> list[str]:
    """Command-line options for those inputs of a job that there are."""
    words: list[str] = []
    for name, option in names.items():
        paths = files.get(name)
        if paths:
            words += [option, *([paths] if isinstance(paths, str) else map(str, paths))]
    return words


@functools.cache
def _stamps(folder: Path) -> str:
    digest = hashlib.sha256()
    kinds = [folder / kind for kind in ("color", "depth", "mask")]
    # Marks are segmented from as images are.
    marks = [path for path in [folder / "marks.json"] if path.exists()]
    for path in sorted([*marks, *(path for kind in kinds for path in kind.rglob("*"))]):
        # A link without target must not end the planning either: whoever reads it says so.
        facts = path.stat() if path.exists() else path.lstat()
        digest.update(f"{path} {facts.st_size} {facts.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def _json(values: Any) -> str:
    return json.dumps(values, sort_keys=True)
