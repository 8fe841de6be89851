"""What the Snakefile asks before any job exists: GPUs, the work in a job, what jobs of a rule need."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from neuspring.config.gpus import Gpus
from neuspring.config.spring_gaus import SpringGaus
from neuspring.config.tuning import Tune
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord
from neuspring.data.cases import released_cases
from neuspring.experiments import benchmark as benchmarks
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.jobs import gpus
from neuspring.experiments.plan import History, Kind, Planned

TRAIN = 0.7
"""Part of the frames that is for training, where only the count of frames is known."""
HEADROOM_MEMORY, HEADROOM_TIME = 1.5, 3.0
"""What is asked for, over the most that earlier jobs needed."""
LEAST_MEMORY, LEAST_MINUTES = 1000, 10
ON_GPU = frozenset({"search", "fit", "rollout", "train", "predict", "transfer", "appearance", "render", "tune"})
"""Rules that take a GPU where there is one."""
EITHER = frozenset({"segment", "track"})
"""Rules whose backend decides."""


def gpu_pool(settings: Gpus, device: str, *, plan_only: bool = False) -> tuple[str, ...]:
    """The GPUs of this machine that jobs may use; none on a CPU. Raises InputError for one that is not there or not allowed.

    `plan_only`: a plan for other machines may be made where there is no GPU.
    """
    if device == "cpu":
        return ()
    visible = gpus.visible_devices()
    chosen = visible if settings.devices == "all" else tuple(map(str, settings.devices))
    with gpus.nvml() as library:
        known = bool(library) or gpus.VISIBLE in os.environ
    missing = [name for name in chosen if name not in visible and name.isdigit()] if known else []
    if missing:
        rule = "every device must be one that this run may use"
        value = f"{', '.join(missing)}; allowed: {', '.join(visible) or 'none'}"
        raise InputError("configuration, gpus.devices", rule, value, f"Correct it, or {gpus.VISIBLE}.")
    if device == "cuda" and not chosen and not plan_only:
        rule = "device: cuda needs a GPU that this run may use, and there is none"
        raise InputError("configuration, device", rule, device, f"Use device: cpu or auto, or correct {gpus.VISIBLE}.")
    return chosen


def gpu_slots(pool: tuple[str, ...], jobs_per_gpu: int, limit: int | None) -> int:
    """How many jobs may hold a GPU at once: all slots, or `limit` (--resources gpu=...). Raises InputError if that cannot be."""
    slots = len(pool) * jobs_per_gpu
    if limit is None:
        return slots
    where, remedy = "--resources gpu", "Leave it out to use them all."
    if limit > slots:
        rule = f"there are {slots} GPU slots ({len(pool)} GPUs, gpus.jobs_per_gpu {jobs_per_gpu})"
        raise InputError(where, rule, limit, remedy)
    if limit < 1:
        raise InputError(where, "jobs on a GPU need one", limit, f"{remedy} Use device: cpu for none.")
    return limit


def check_gpus(rules: Mapping[str, Mapping[str, Any]], pool: tuple[str, ...]) -> None:
    """Raise InputError if resources that were set for a rule (--set-resources) name more GPUs than this machine has."""
    for rule, resources in rules.items():
        wanted = resources["gpu"].value if "gpu" in resources and not resources["gpu"].is_evaluable() else 0
        if isinstance(wanted, int) and wanted > len(pool):
            limit = f"a job has its GPUs at once, and there are {len(pool)} ({', '.join(pool) or 'none'})"
            raise InputError(f"--set-resources {rule}:gpu", limit, wanted, "Ask for fewer.")


def check_storage(tune: Tune, *, cluster: bool) -> None:
    """Raise InputError if workers of a study on several machines would share an SQLite file, whose locks hold within one alone."""
    if cluster and tune.workers > 1 and tune.storage is None:
        rule = "workers on several machines need storage: postgresql://...; SQLite is for those of one machine"
        raise InputError("configuration, tune.storage", rule, None, "Name a PostgreSQL database, or use workers: 1.")


def planned(jobs: Iterable[Any], results: Path) -> list[Planned]:
    """Jobs of Snakemake's DAG as `neuspring.experiments.plan` takes them; targets, which have no log, do nothing."""
    return [
        Planned(
            rule=JobRecord.of_log(results, Path(job.log[0])).rule,
            scenario=getattr(job.wildcards, "scenario", ""),
            kind="gpu" if job.resources.get("gpu") else "cpu",
            work=float(job.resources.get("work", 1)),
        )
        for job in jobs
        if len(job.log)
    ]


class Needs:
    """Work, memory and time of jobs: from the configuration, and from what earlier jobs of this results folder needed."""

    def __init__(self, benchmark: Benchmark, kind: Kind) -> None:
        self._benchmark, self._kind = benchmark, kind

    @cached_property
    def history(self) -> History:
        """Earlier jobs of the results folder."""
        return History.of(Path(self._benchmark.config.results))

    def frames(self, scenario: str) -> int:
        """Frames of a scenario, as far as they are known before its data are read; 1 otherwise."""
        config, row = self._benchmark.config, self._benchmark.scenarios[scenario]
        if row.source == "toy":
            return config.toy.frames
        if row.source == "mocap":
            return config.mocap.frames or 1
        # Synthetic scenes have the names and lengths of the released ones.
        facts = released_cases().get(Path(row.path).name)
        frames = int(facts["frames"]) if facts else 1
        return min(frames, config.synthetic.frames or frames) if row.source == "synthetic" else frames

    def search(self, wildcards: Any) -> int:
        """Rollouts x training frames."""
        row = self._benchmark.searches[wildcards.search]
        rollouts = benchmarks.search_of(self._benchmark.config, row, wildcards.search).rollouts
        return rollouts * math.ceil(TRAIN * self.frames(wildcards.scenario))

    def fit(self, wildcards: Any) -> int:
        """Epochs x training frames."""
        epochs = benchmarks.fit_of(self._benchmark.config, self._benchmark.fits[wildcards.method], wildcards.method).epochs
        return epochs * math.ceil(TRAIN * self.frames(wildcards.scenario))

    def train(self, wildcards: Any) -> int:
        """Spring-Gaus: iterations x training frames. GS-Dynamics: updates."""
        method, name = self._benchmark.methods[wildcards.method], wildcards.method
        chosen = benchmarks.model_of(self._benchmark.config, method, name)
        if isinstance(chosen, SpringGaus):
            return chosen.iterations * math.ceil(TRAIN * self.frames(wildcards.scenario))
        return chosen.epochs * chosen.updates_per_epoch

    def appearance(self, wildcards: Any) -> int:
        """Iterations, of the splats of all methods or of one method's own."""
        owner = wildcards.looks.removeprefix("appearance-")
        if owner not in self._benchmark.splats:
            return self._benchmark.config.images.appearance.iterations
        return benchmarks.appearance_of(self._benchmark.config, self._benchmark.splats[owner], owner).iterations

    def scenario(self, wildcards: Any) -> int:
        """Frames."""
        return self.frames(wildcards.scenario)

    def memory(self, rule: str, default: int) -> Callable[..., int]:
        """MB to ask for: half as much again as earlier jobs of the rule needed with the same scenario, else as those with others
        or `default`, whichever is more. Later attempts ask for at least `default`, times the attempt."""

        def known(scenario: str) -> float:
            peaks = self.history.memory
            return HEADROOM_MEMORY * max(peaks.get((rule, kind, scenario), 0.0) for kind in self._kinds(rule))

        def needed(wildcards: Any, attempt: int) -> int:
            return _asked(wildcards, attempt, default, known, LEAST_MEMORY)

        return needed

    def minutes(self, rule: str, default: int, work: Callable[[Any], int]) -> Callable[..., int]:
        """Minutes to ask for: three times what earlier jobs took for as much work; otherwise as for memory."""

        def expected(scenario: str, wildcards: Any) -> float:
            rate = max(self.history.rates.get((rule, kind, scenario), 0.0) for kind in self._kinds(rule))
            return HEADROOM_TIME * rate * work(wildcards) / 60 if rate else 0.0

        def needed(wildcards: Any, attempt: int) -> int:
            return _asked(wildcards, attempt, default, lambda scenario: expected(scenario, wildcards), LEAST_MINUTES)

        return needed

    def _kinds(self, rule: str) -> tuple[Kind, ...]:
        """The jobs that tell something of a rule's next ones: a GPU takes other memory and time than the CPU."""
        if self._kind == "gpu" and rule in ON_GPU:
            return ("gpu",)
        return ("cpu", "gpu") if rule in EITHER else ("cpu",)


def _asked(wildcards: Any, attempt: int, default: int, known: Callable[[str], float], least: int) -> int:
    """What an attempt asks for, `known` being what earlier jobs of a scenario, or of all (""), tell; 0: nothing."""
    own, others = known(getattr(wildcards, "scenario", "")), known("")
    asked = max(math.ceil(own), least) if own else max(math.ceil(others), default)
    # What failed with as little as earlier jobs needed may have failed for want of it.
    return asked if attempt == 1 else attempt * max(asked, default)
