"""Where the time went: hours by step and by method, waiting, memory, retries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from neuspring.core.job_records import JobRecord
from neuspring.report.blocks import Block, Cell, Section, Table, Text
from neuspring.report.page.sources import METHOD_RULES, Material, Run
from neuspring.report.page.words import duration, hours, memory
from neuspring.scores.metrics import DASH

ORDER = (
    *("capture", "synthesize", "segment", "track", "lift", "judge", "observe", "search", "fits", "fit", "rollout"),
    *("train", "predict", "transfer", "appearance", "render", "score", "tables", "study", "report", "log_run", "track_init"),
)
"""Rules in the order of the workflow."""


def place(rule: str) -> int:
    """Where a rule stands in the workflow; unknown rules come last."""
    return ORDER.index(rule) if rule in ORDER else len(ORDER)


def _grouped(jobs: Iterable[JobRecord], key: Callable[[JobRecord], str]) -> dict[str, list[JobRecord]]:
    groups: dict[str, list[JobRecord]] = defaultdict(list)
    for job in jobs:
        groups[key(job)].append(job)
    return groups


def _owner(job: JobRecord) -> str:
    parts = job.name.split("/")
    if len(parts) != 4:
        return ""
    if job.rule == "search":
        return f"search {parts[2]}"
    if job.rule == "appearance":
        return f"splats {_splats(parts[2])}"
    return parts[2] if job.rule in (*METHOD_RULES, "transfer") else ""


def _splats(folder: str) -> str:
    """The owner of the splats in a folder: a method, or `shared`."""
    return folder.removeprefix("appearance").removeprefix("-") or "shared"


def gpu_hours(material: Material) -> tuple[float | None, str]:
    """GPU-hours (None where nothing is known), and where they are from: job records, else run records."""
    if material.jobs:
        return _gpu_seconds(material.jobs) / 3600, "job records"
    if not material.runs:
        return None, "no records"
    return sum(seconds for _, _, seconds, device, _ in _stages(material.runs) if device.startswith("cuda")) / 3600, "run records"


def _stages(runs: Iterable[Run]) -> list[tuple[str, str, float, str, float]]:
    """Rule, method, seconds, device and MiB of every stage. Shared stages count once: for `shared`, or the method of the splats."""
    seen, rows = set(), []
    for run in runs:
        paths = [(run.folder / name).resolve() for name in run.record.artifacts.get("records", [])]
        places = {path.stem: path for path in paths}
        for stage, seconds in run.record.timings.items():
            place = places.get(stage, run.folder / stage)
            if place in seen:
                continue
            seen.add(place)
            # Scoring is done on the CPU, whatever the device.
            device = "cpu" if stage == "score" else run.record.device
            peak = run.record.peak_memory_mb.get(stage, np.nan)
            folder = place.parent.parent.name
            owner = "shared" if stage == "search" else _splats(folder) if stage == "appearance" else run.method
            rule = "predict" if stage == "rollout" and run.record.model else stage
            rows.append((rule, owner, seconds, device, peak))
    return rows


def section(material: Material) -> Section:
    """Tables of hours."""
    title = "Time and hardware"
    if material.jobs:
        return Section(key="work", title=title, about=_about(material.jobs), blocks=_from_jobs(material.jobs))
    if not material.runs:
        return Section(key="work", title=title, blocks=[Text(text="Nothing has been timed yet.", tone="mute")])
    note = "There are no job records: times are those of the run records, without failed attempts, waiting and steps outside runs."
    return Section(key="work", title=title, blocks=[Text(text=note, tone="mute"), _from_runs(material.runs)])


def _about(jobs: Sequence[JobRecord]) -> str:
    attempts = [attempt for job in jobs for attempt in job.attempts]
    hosts = sorted({a.host for a in attempts if a.host})
    names = sorted({name for a in attempts for name in a.device_names})
    return f"Hosts: {', '.join(hosts) or 'unknown'}. GPUs: {', '.join(names) or 'none used'}. Times include failed attempts."


def _from_jobs(jobs: Sequence[JobRecord]) -> list[Block]:
    by_rule, by_method = _grouped(jobs, lambda job: job.rule), _grouped(jobs, _owner)
    rules = sorted(by_rule, key=lambda name: (place(name), name))
    steps = {name: by_rule[name] for name in rules} | ({"all": jobs} if len(rules) > 1 else {})
    methods = {name: by_method[name] for name in sorted(by_method) if name}
    blocks: list[Block] = [_costs("By step", "Step", steps, sortable=False)]
    if methods:
        caption = "By method (searches and splats apart, since methods share them)"
        blocks.append(_costs(caption, "Method", methods, sortable=True))
    return blocks


def _costs(caption: str, what: str, groups: Mapping[str, Sequence[JobRecord]], *, sortable: bool) -> Table:
    header = [what, "Jobs", "Failed", "Retries", "Median", "Longest", "GPU-hours", "CPU-hours", "Waited", "Peak memory"]
    header += ["GPU memory", "GPU use"]
    rows = [_cost(name, jobs) for name, jobs in groups.items()]
    on_gpu = any(attempt.devices for jobs in groups.values() for job in jobs for attempt in job.attempts)
    note = "Waited: for a GPU. A GPU that two jobs share counts for both." if on_gpu else ""
    return Table(caption=caption, header=header, rows=rows, sortable=sortable, note=note)


def _cost(name: str, jobs: Sequence[JobRecord]) -> list[Cell]:
    """The cost of some jobs, their failed attempts included."""
    attempts = [attempt for job in jobs for attempt in job.attempts]
    failed, retries = sum(job.failed for job in jobs), sum(len(job.attempts) - 1 for job in jobs)
    seconds = [job.seconds for job in jobs]
    median, longest = float(np.median(seconds)), max(seconds)
    on_gpu, waited = _gpu_seconds(jobs), sum(a.waited for a in attempts)
    peak = max((a.peak_memory_mb for a in attempts), default=0.0)
    gpu_peak = max((a.peak_gpu_memory_mb for a in attempts if a.peak_gpu_memory_mb is not None), default=None)
    used = [(a.gpu_utilization, a.seconds * len(a.devices)) for a in attempts if a.gpu_utilization is not None and a.seconds > 0]
    weight = sum(weight for _, weight in used)
    use = sum(percent * weight for percent, weight in used) / weight if weight else None
    return [
        Cell(text=name),
        _number(len(jobs)),
        Cell(text=str(failed), tone="bad" if failed else "", value=failed),
        _number(retries),
        Cell(text=duration(median), value=median),
        Cell(text=duration(longest), value=longest),
        _hours(on_gpu),
        _hours(sum(a.cpu_seconds for a in attempts)),
        Cell(text=duration(waited) if on_gpu else DASH, value=waited),
        Cell(text=memory(peak), value=peak),
        Cell(text=memory(gpu_peak), value=gpu_peak or 0.0),
        Cell(text=DASH if use is None else f"{use:.0f} %", value=use or 0.0),
    ]


def _gpu_seconds(jobs: Iterable[JobRecord]) -> float:
    return sum(attempt.seconds * len(attempt.devices) for job in jobs for attempt in job.attempts)


def _number(value: int) -> Cell:
    return Cell(text=f"{value:,}", value=value)


def _hours(seconds: float) -> Cell:
    return Cell(text=hours(seconds) if seconds else DASH, value=seconds)


def _from_runs(runs: Sequence[Run]) -> Table:
    groups: dict[tuple[str, str], list[tuple[float, str, float]]] = defaultdict(list)
    for stage, method, seconds, device, peak in _stages(runs):
        groups[stage, method].append((seconds, device, peak))
    rows = []
    for (stage, method), records in sorted(groups.items(), key=lambda item: (place(item[0][0]), item[0][1])):
        times = [seconds for seconds, _, _ in records]
        on_gpu = sum(seconds for seconds, device, _ in records if device.startswith("cuda"))
        peak = max((mebibytes for _, _, mebibytes in records if np.isfinite(mebibytes)), default=np.nan)
        cells = [Cell(text=duration(v), value=v) for v in (float(np.median(times)), max(times))]
        rows.append(
            [
                Cell(text=stage),
                Cell(text=method),
                _number(len(records)),
                *cells,
                _hours(sum(times)),
                _hours(on_gpu),
                Cell(text=memory(peak), value=peak),
            ]
        )
    header = ["Step", "Method", "Records", "Median", "Longest", "Hours", "GPU-hours", "Peak memory"]
    return Table(caption="By step and method", header=header, rows=rows, stub=2, sortable=True)


def machines(runs: Iterable[Run]) -> dict[str, int]:
    """Machine and device to the number of runs."""
    counts: dict[str, int] = defaultdict(int)
    for run in runs:
        counts[f"{run.record.machine}; {run.record.device}"] += 1
    return dict(sorted(counts.items()))
