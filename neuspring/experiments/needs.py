"""What the Snakefile asks before any job exists: GPUs, the work in a job, what jobs of a rule need."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.config.gpus import Gpus
from neuspring.core.errors import InputError
from neuspring.core.job_records import SIMULATING, JobRecord
from neuspring.experiments import benchmark as benchmarks
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.jobs import gpus
from neuspring.experiments.plan import History, Kind, Planned
from neuspring.experiments.size import TRAIN, Body, Size, Sizes
from neuspring.stages import STAGES

CARRY_OVER = 4
"""Rollouts that carrying over the state costs: the prediction, the training frames again, and 12 continuations of some of them."""
HEADROOM_MEMORY, HEADROOM_TIME = 1.5, 3.0
"""What is asked for, over the most that earlier jobs needed."""
LEAST_MEMORY, LEAST_MINUTES = 1000, 10
ALWAYS_GPU = frozenset({"tune", *(name for name, stage in STAGES.items() if stage.gpu == "always")})
"""Rules that take a GPU where there is one."""
BACKEND_DECIDES = frozenset(name for name, stage in STAGES.items() if stage.gpu == "backend")
"""Rules whose backend decides whether they take a GPU."""
FIRST_GUESS = {name: (stage.memory_mb, stage.minutes) for name, stage in STAGES.items()} | {
    "tables": (2000, 10),
    "study": (2000, 10),
    "report": (4000, 20),
    "perception_table": (2000, 10),
    "track_init": (2000, 10),
    "log_run": (2000, 10),
    "tune": (8000, 2880),
    "sweep": (4000, 20),
    "log_sweep": (2000, 30),
}
"""Rule -> MB and minutes to ask for, before any job of it was measured."""


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


def pool_of(config: Config, workflow: Any) -> tuple[str, ...]:
    """The GPUs of this machine that jobs lease, which Snakemake is told of. Raises InputError.

    A request above the limit is an error here, before any job: Snakemake would clamp it.
    """
    wish = workflow.global_resources.get("gpu")
    limit = wish.value if wish else None
    pool = gpu_pool(config.gpus, config.device, plan_only=workflow.output_settings.dryrun)
    check_gpus(workflow.resource_settings.overwrite_resources, pool)
    if pool:
        workflow.register_resource("gpu", gpu_slots(pool, config.gpus.jobs_per_gpu, limit))
    elif limit:
        remedy = "Leave it out, or set device: cuda where there is one."
        raise InputError("--resources gpu", "no job of this run can have a GPU", limit, remedy)
    return pool


def planned(jobs: Iterable[Any], needs: Needs) -> list[Planned]:
    """Jobs of Snakemake's DAG as `neuspring.experiments.plan` takes them; targets, which have no log, do nothing."""
    results, found = needs.results, []
    for job in jobs:
        if not len(job.log):
            continue
        rule = JobRecord.of_log(results, Path(job.log[0])).rule
        work, size = needs.amount(rule, job.wildcards) if rule in SIMULATING else (float(job.resources.get("work", 1)), None)
        kind: Kind = "gpu" if job.resources.get("gpu") else "cpu"
        found.append(Planned(rule=rule, scenario=getattr(job.wildcards, "scenario", ""), kind=kind, work=work, size=size))
    return found


class Needs:
    """Work, memory and time of jobs: from the configuration, and from what earlier jobs of this results folder needed."""

    def __init__(self, benchmark: Benchmark, kind: Kind) -> None:
        self._benchmark, self._kind = benchmark, kind
        self.results = Path(benchmark.config.results)
        self.sizes = Sizes(benchmark)
        # Thousands of jobs share a few rows.
        config = benchmark.config
        self._rollouts = cache(lambda name: benchmarks.search_of(config, benchmark.searches[name], name).rollouts)
        self._epochs = cache(lambda name: benchmarks.fit_of(config, benchmark.fits[name], name).total_epochs)

    @cached_property
    def history(self) -> History:
        """Earlier jobs of the results folder."""
        return History.of(self.results)

    def frames(self, scenario: str) -> int:
        """Frames of a scenario, as far as they are known before its data are read; 1 otherwise."""
        row = self._benchmark.scenarios[scenario]
        return self._benchmark.source(scenario).frames(row, self._benchmark.config)

    def work(self, rule: str, wildcards: Any) -> int:
        """How much a job has to do, as a whole number.

        Jobs that simulate: frames, of which a search has its rollouts x training frames, a fit its epochs x training frames, a
        rollout those of all its seeds, a transfer those of all its recordings. train: see `Baseline.work`; appearance: iterations;
        other jobs of a scenario: frames; jobs of no scenario: 1.
        """
        benchmark, config = self._benchmark, self._benchmark.config
        if rule in SIMULATING:
            return self._simulated(rule, wildcards)
        if rule == "appearance":
            owner = wildcards.looks.removeprefix("appearance-")
            own = benchmark.splats.get(owner)
            settings = benchmarks.appearance_of(config, own, owner) if own else config.images.appearance
            return settings.iterations
        if not hasattr(wildcards, "scenario"):
            return 1
        frames = self.frames(wildcards.scenario)
        if rule == "train":
            method = benchmark.methods[wildcards.method]
            section = benchmarks.section_of(config, method, wildcards.method)
            return BASELINES[method.model or ""].work(section, math.ceil(TRAIN * frames))
        return frames

    def _simulated(self, rule: str, wildcards: Any) -> int:
        """Frames that a job simulates; frame 0 is given."""
        benchmark, body = self._benchmark, self.sizes.body(wildcards.scenario)
        if rule == "search":
            return int(self._rollouts(wildcards.search) * self._training_frames(wildcards))
        together = benchmark.fits_together(wildcards.scenario) if rule in ("fits", "fit") else ()
        if rule == "fits":
            return int(sum(self._epochs(method) * self._fitted(method, body) for method, _ in together))
        if rule == "fit":
            if (wildcards.method, int(wildcards.seed)) in together:
                return 1  # what runs together is the work of `fits`
            return int(self._epochs(wildcards.method) * self._training_frames(wildcards))
        if rule == "transfer":
            return sum(self.sizes.body(name).frames - 1 for name in benchmark.transfers[wildcards.scenario])
        method = benchmark.methods[wildcards.method]
        seeds = len(benchmark.whole.seeds) if method.average_seeds else 1
        return (body.frames - 1) * seeds * (CARRY_OVER if method.carry_over else 1)

    def _training_frames(self, job: Any) -> int:
        """Frames after frame 0 that a search or a fit is judged on, on all recordings that count."""
        kind = self._benchmark.pool_kind(job)
        counted = [*([] if kind == "others" else [job.scenario]), *(self._benchmark.pools[job.scenario] if kind else ())]
        bodies = [self.sizes.body(name) for name in counted]
        return sum(self._fitted(job.method, body) if hasattr(job, "method") else body.train_end - 1 for body in bodies)

    def _fitted(self, method: str, body: Body) -> int:
        """Frames that an epoch of a fit simulates on one recording."""
        return (body.frames if self._benchmark.fits[method].oracle else body.train_end) - 1

    def amount(self, rule: str, wildcards: Any) -> tuple[float | None, Size | None]:
        """A job's work in the unit of its times, and, if it simulates, the size of its twins.

        Jobs that simulate: 1e9 spring updates; None for the transfer of a baseline, which has no springs. Others: see `work`.
        """
        work = self.work(rule, wildcards)
        if rule not in SIMULATING:
            return work, None
        if rule == "search":
            search = wildcards.search
        elif rule == "fits":
            together = self._benchmark.fits_together(wildcards.scenario)
            search = self._benchmark.fits[together[0][0]].searched if together else None
        else:
            rows = self._benchmark.fits if rule == "fit" else self._benchmark.methods
            search = rows[wildcards.method].searched or None
        if search is None:
            return None, None
        size = self.sizes.of(wildcards.scenario, search, rule == "search")
        return work * size.updates / 1e9, size

    def memory(self, rule: str) -> Callable[..., int]:
        """MB to ask for: half as much again as earlier jobs of the rule needed with the same scenario.

        Without such jobs: what jobs with other scenarios needed, or the first guess, whichever is more. Later attempts ask for at
        least the first guess, times the attempt.
        """
        default, _ = FIRST_GUESS[rule]

        def known(scenario: str) -> float:
            peaks = self.history.memory
            return HEADROOM_MEMORY * max(peaks.get((rule, kind, scenario), 0.0) for kind in self._kinds(rule))

        def needed(wildcards: Any, attempt: int) -> int:
            return _asked(wildcards, attempt, default, known, LEAST_MEMORY)

        return needed

    def minutes(self, rule: str) -> Callable[..., int]:
        """Minutes to ask for: three times what earlier jobs took for as much work; otherwise as for memory."""
        _, default = FIRST_GUESS[rule]

        def expected(scenario: str, wildcards: Any) -> float:
            rate = max(self.history.rates.get((rule, kind, scenario), 0.0) for kind in self._kinds(rule))
            return HEADROOM_TIME * rate * (self.amount(rule, wildcards)[0] or 0.0) / 60 if rate else 0.0

        def needed(wildcards: Any, attempt: int) -> int:
            return _asked(wildcards, attempt, default, lambda scenario: expected(scenario, wildcards), LEAST_MINUTES)

        return needed

    def _kinds(self, rule: str) -> tuple[Kind, ...]:
        """Which earlier jobs predict the next ones of a rule: memory and time on a GPU differ from those on the CPU."""
        if self._kind == "gpu" and rule in ALWAYS_GPU:
            return ("gpu",)
        return ("cpu", "gpu") if rule in BACKEND_DECIDES else ("cpu",)


def _asked(wildcards: Any, attempt: int, default: int, known: Callable[[str], float], least: int) -> int:
    """What an attempt asks for. `known` maps a scenario, or "" for all, to what its earlier jobs needed; 0 where there are none."""
    own, others = known(getattr(wildcards, "scenario", "")), known("")
    asked = max(math.ceil(own), least) if own else max(math.ceil(others), default)
    # What failed with as little as earlier jobs needed may have failed for want of it.
    return asked if attempt == 1 else attempt * max(asked, default)
