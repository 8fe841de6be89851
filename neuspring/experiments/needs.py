"""Answers to the Snakefile before any job exists: a checked benchmark, GPUs of this machine, memory and time of jobs.

A job asks for somewhat more than the most that earlier jobs of its rule needed, on the same scenario if there were any. Without
earlier jobs it asks for its stage's first request (`memory_mb`, `minutes`).
"""

from __future__ import annotations

import math
import os
import statistics
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from neuspring.config import Config
from neuspring.config.settings import Gpus
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord, read_jobs
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.jobs import gpus
from neuspring.stages import STAGES

Kind = Literal["cpu", "gpu"]
Key = tuple[str, Kind, str]
"""Rule, kind and scenario of jobs; scenario "": of all."""
HEADROOM_MEMORY, HEADROOM_TIME = 1.5, 3.0
"""Factors on the most that earlier jobs needed."""
LEAST_MEMORY, LEAST_MINUTES = 1000, 10
ALWAYS_GPU = frozenset({"tune", *(name for name, stage in STAGES.items() if stage.gpu is True)})
"""Rules that take a GPU where there is one."""
BACKEND_DECIDES = frozenset(name for name, stage in STAGES.items() if callable(stage.gpu))
"""Rules whose backend decides whether they take a GPU."""
FIRST_REQUEST = {name: (stage.memory_mb, stage.minutes) for name, stage in STAGES.items()} | {
    "tables": (2000, 10),
    "study": (2000, 10),
    "report": (4000, 20),
    "perception_table": (2000, 10),
    "track_init": (2000, 10),
    "log_run": (2000, 10),
    "tune": (8000, 2880),
    "sweep": (4000, 20),
}
"""Rule -> MB and minutes to ask for, before any job of it was measured."""
UNITS_OF_WORK: dict[str, Callable[[Config], int]] = {
    "search": lambda config: config.search.rollouts,
    "fit": lambda config: config.fit.epochs,
    "appearance": lambda config: config.images.appearance.iterations,
}
"""Rule -> units of work in one of its jobs."""
PUBLISHED: dict[tuple[str, Kind], float] = {
    **{("search", "gpu"): 12 * 60 / 220, ("fit", "gpu"): 5 * 60 / 200, ("rollout", "gpu"): 12 * 60 / 220},
    **{("search", "cpu"): 12.8 / 88, ("fit", "cpu"): 27.8 / 20, ("rollout", "cpu"): 1.4, ("score", "cpu"): 2.9},
    **{("appearance", "cpu"): 46.1 / 300, ("render", "cpu"): 8.9, ("capture", "cpu"): 60.0, ("segment", "cpu"): 6.9},
    **{("track", "cpu"): 5.1, ("lift", "cpu"): 15.1, ("observe", "cpu"): 1.3, ("judge", "cpu"): 2.0, ("log_run", "cpu"): 3.8},
    **{("track_init", "cpu"): 6.7, ("tables", "cpu"): 2.9, ("report", "cpu"): 5.7, ("perception_table", "cpu"): 0.3},
    # What it does is counted as the time of the fits.
    **{("fits", "gpu"): 0.0, ("fits", "cpu"): 0.0},
}
"""Rule and kind -> s per unit of work, before any job of it was measured."""
PUBLISHED_BY: dict[Kind, str] = {
    "gpu": "PhysTwin's README: one stuffed animal, 220 rollouts and 200 epochs on an RTX 4090",
    "cpu": "jobs of make demo: 300 nodes, 45 frames, two vCPUs of an AMD EPYC",
}
"""Source of the figures of `PUBLISHED`."""


def checked(values: Mapping[str, Any], root: Path, *, plan_only: bool = False) -> Benchmark:
    """The benchmark of a configuration, after everything that can be checked before a job starts. Raises InputError.

    `plan_only`: a plan may be made where data are not there yet.
    """
    benchmark = Benchmark(values, root, plan_only=plan_only)
    results = Path(benchmark.config.results)
    try:
        results.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=results).close()
    except OSError as error:
        where, rule = f"configuration, results ({results})", "this folder must be writable"
        raise InputError(where, rule, error.strerror, "Choose another: --config results=...") from error
    return benchmark


def pool_of(config: Config, workflow: Any) -> tuple[str, ...]:
    """The GPUs of this machine that jobs lease, which Snakemake is told of. Raises InputError.

    A request above the limit is an error here, before any job: Snakemake would clamp it.
    """
    wish = workflow.global_resources.get("gpu")
    pool = gpu_pool(config.gpus, config.device, plan_only=workflow.output_settings.dryrun)
    wishes = {rule: wishes["gpu"] for rule, wishes in workflow.resource_settings.overwrite_resources.items() if "gpu" in wishes}
    check_gpus({rule: gpu.value for rule, gpu in wishes.items() if not gpu.is_evaluable()}, pool)
    if slots := gpu_slots(pool, config.gpus.jobs_per_gpu, wish.value if wish else None):
        workflow.register_resource("gpu", slots)
    return pool


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


def gpu_slots(pool: Sequence[str], jobs_per_gpu: int, limit: int | None) -> int:
    """Number of jobs that may hold a GPU at once: all slots, or `limit` (--resources gpu=...). Raises InputError."""
    slots = len(pool) * jobs_per_gpu
    where = "--resources gpu"
    if limit and not pool:
        raise InputError(where, "no job of this run can have a GPU", limit, "Leave it out, or set device: cuda where there is one.")
    if limit is None or not pool:
        return slots
    if not 1 <= limit <= slots:
        rule = f"at least one, and there are {slots} GPU slots ({len(pool)} GPUs, gpus.jobs_per_gpu {jobs_per_gpu})"
        raise InputError(where, rule, limit, "Leave it out to use them all. Use device: cpu for none.")
    return limit


def check_gpus(wishes: Mapping[str, Any], pool: Sequence[str]) -> None:
    """Raise InputError if GPUs that were set for a rule (--set-resources) are more than this machine has."""
    for rule, wanted in wishes.items():
        if isinstance(wanted, int) and wanted > len(pool):
            limit = f"a job has its GPUs at once, and there are {len(pool)} ({', '.join(pool) or 'none'})"
            raise InputError(f"--set-resources {rule}:gpu", limit, wanted, "Ask for fewer.")


@dataclass(frozen=True)
class History:
    """Earlier jobs of a results folder."""

    seconds: Mapping[Key, float] = field(default_factory=dict)
    """Longest wall time of jobs that succeeded."""
    memory: Mapping[Key, float] = field(default_factory=dict)
    """Largest resident memory of any attempt, MiB."""
    median: Mapping[tuple[str, Kind], float] = field(default_factory=dict)
    """Median wall time of jobs that succeeded, s, by rule and kind."""

    @classmethod
    def of(cls, records: Iterable[JobRecord]) -> History:
        """From job records. The time of a job is that of its last success, with the attempts that it went on from."""
        seconds: dict[Key, float] = defaultdict(float)
        memory: dict[Key, float] = defaultdict(float)
        every: dict[tuple[str, Kind], list[float]] = defaultdict(list)
        for record in records:
            for attempt in record.attempts:
                for scenario in {"", record.scenario}:
                    key = (record.rule, attempt.kind, scenario)
                    memory[key] = max(memory[key], attempt.peak_memory_mb)
            ends = [-1, *(place for place, attempt in enumerate(record.attempts) if attempt.outcome == "ok")]
            if len(ends) > 1:
                took = sum(attempt.seconds for attempt in record.attempts[ends[-2] + 1 : ends[-1] + 1])
                every[record.rule, record.attempts[ends[-1]].kind].append(took)
                for scenario in {"", record.scenario}:
                    key = (record.rule, record.attempts[ends[-1]].kind, scenario)
                    seconds[key] = max(seconds[key], took)
        return cls(dict(seconds), dict(memory), {key: statistics.median(times) for key, times in every.items()})


class Needs:
    """Memory and time to ask for, and to expect."""

    def __init__(self, benchmark: Benchmark, kind: Kind) -> None:
        self.results, self._kind, self._config = Path(benchmark.config.results), kind, benchmark.config

    @cached_property
    def history(self) -> History:
        """Earlier jobs of the results folder; damaged records are passed over."""
        return History.of(read_jobs(self.results, damaged=[]))

    def memory(self, rule: str) -> Callable[..., int]:
        """(wildcards, attempt) -> MB to ask for: half as much again as the most that earlier jobs needed."""
        first, _ = FIRST_REQUEST[rule]
        return self._request(rule, first, LEAST_MEMORY, lambda key: HEADROOM_MEMORY * self.history.memory.get(key, 0.0))

    def minutes(self, rule: str) -> Callable[..., int]:
        """(wildcards, attempt) -> minutes to ask for: three times the longest that earlier jobs took."""
        _, first = FIRST_REQUEST[rule]
        return self._request(rule, first, LEAST_MINUTES, lambda key: HEADROOM_TIME * self.history.seconds.get(key, 0.0) / 60)

    def expected(self, rule: str) -> tuple[Kind, float | None, bool]:
        """The kind of a rule's jobs, seconds of one, and True where earlier jobs say so: their median, else `PUBLISHED`."""
        kind: Kind = "gpu" if self._kind == "gpu" and rule in ALWAYS_GPU else "cpu"
        if self._kind == "gpu" and rule in BACKEND_DECIDES and (rule, "gpu") in self.history.median:
            kind = "gpu"
        if (rule, kind) in self.history.median:
            return kind, self.history.median[rule, kind], True
        published = PUBLISHED.get((rule, kind))
        return kind, None if published is None else published * UNITS_OF_WORK.get(rule, lambda config: 1)(self._config), False

    def _request(self, rule: str, first: int, least: int, known: Callable[[Key], float]) -> Callable[..., int]:
        """`known`: what earlier jobs call for; 0 where there are none."""
        # Memory and time on a GPU differ from those on the CPU.
        kinds: tuple[Kind, ...] = ("cpu", "gpu") if rule in BACKEND_DECIDES else ("cpu",)
        if self._kind == "gpu" and rule in ALWAYS_GPU:
            kinds = ("gpu",)

        def asked(wildcards: Any, attempt: int) -> int:
            own, others = (max(known((rule, kind, name)) for kind in kinds) for name in (getattr(wildcards, "scenario", ""), ""))
            # Jobs on other scenarios say no more than that this one may need as much.
            once = max(math.ceil(own), least) if own else max(math.ceil(others), first)
            # What failed with as little as earlier jobs needed may have failed for want of it.
            return once if attempt == 1 else attempt * max(once, first)

        return asked
