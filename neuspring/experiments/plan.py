"""Text of a plan, before the first job and in a dry run: missing data, hours, devices, tables, and what later files change."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuspring.config import Config, merge, plain
from neuspring.config.parse import read_yaml
from neuspring.core.run_record import flat
from neuspring.core.text import duration, listed
from neuspring.experiments.graph import Graph
from neuspring.experiments.needs import FIRST_REQUEST, PUBLISHED_BY, Kind, Needs

MOST_CHANGES, LONGEST_CHANGE = 6, 70
"""Keys that are told per file, and characters of a value."""
MOST_RULES = 4
"""Rules that are told with their times, those that take longest."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Devices of a run."""

    gpus: Sequence[str]
    cores: int
    cluster: bool = False
    """True where a scheduler hands out devices."""


def told(graph: Graph, needs: Needs, counts: Mapping[str, int], place: Place, files: Sequence[Path]) -> str:
    """A dozen lines at most; none where nothing is to be done. `counts`: rule -> jobs; `files`: those of --configfile, in order."""
    jobs = {rule: count for rule, count in counts.items() if rule in FIRST_REQUEST}
    if not jobs and graph.benchmark.absent is None:
        return ""
    lines = [("data", f"{graph.benchmark.absent} A run ends here, before its first job.")] if graph.benchmark.absent else []
    lines += [("time", line) for line in _times(needs, jobs, place)]
    lines += [("devices", _devices(graph.config, place, on_gpu=graph.benchmark.on_gpu))]
    studies = f", studies/ ({listed(graph.config.studies)})" if graph.config.studies else ""
    lines += [("tables", f"{graph.folder}/summary.md, report.html{studies}")]
    lines += [("files", line) for line in changes(files)]
    heads = [head if k == 0 or lines[k - 1][0] != head else "" for k, (head, _) in enumerate(lines)]
    return "\n".join(["Plan:", *(f"  {head:<8} {line}" for head, (_, line) in zip(heads, lines, strict=True)), ""])


def _times(needs: Needs, jobs: Mapping[str, int], place: Place) -> Iterable[str]:
    """A line per kind of device, and one of what is not known."""
    unknown: list[str] = []
    for kind in ("gpu", "cpu"):
        each: dict[str, tuple[float, bool]] = {}
        missing = []
        for rule in jobs:
            of, seconds, recorded = needs.expected(rule)
            if of == kind and seconds is None:
                missing.append(f"{rule} ({jobs[rule]:,})")
            elif of == kind and seconds is not None:
                each[rule] = (seconds, recorded)
        unknown += missing
        if not each:
            continue
        total = sum(jobs[rule] * seconds for rule, (seconds, _) in each.items())
        first = sorted(each, key=lambda rule: -jobs[rule] * each[rule][0])[:MOST_RULES]
        parts = ", ".join(f"{rule} {jobs[rule]:,} x {duration(each[rule][0])}" for rule in first if each[rule][0])
        sources = [text for known, text in ((True, "jobs of this results folder"), (False, PUBLISHED_BY[kind]))
                   if known in {recorded for _, recorded in each.values()}]  # fmt: skip
        least = "at least " if missing else ""
        yield f"{least}{duration(total)} of {kind.upper()} time{_shared_out(kind, total, place)}: {parts} (by {'; '.join(sources)})"
    if unknown:
        yield f"without a figure, and not counted: {listed(unknown)}"


def _shared_out(kind: Kind, total: float, place: Place) -> str:
    """The time on all devices together; nothing where a scheduler hands them out."""
    count, noun = (len(place.gpus), "GPU") if kind == "gpu" else (place.cores, "core")
    if place.cluster or not count:
        return ""
    return f", {duration(total / count)} on {count} {noun}{'s' * (count > 1)}"


def _devices(config: Config, place: Place, *, on_gpu: bool) -> str:
    if place.cluster:
        return "the cluster's scheduler gives each job its own"
    cores = f"{place.cores} core{'s' * (place.cores > 1)}, one a job"
    if not on_gpu:
        return f"{cores}; no GPU"
    share = config.gpus.jobs_per_gpu
    shared = f"{share} job{'s' * (share > 1)} on each at once (gpus.jobs_per_gpu)"
    together = f"candidates of a search, and fits of a scenario, share launches (twins_per_launch: {config.twins_per_launch})"
    if not place.gpus:
        return f"There is no GPU here: device: cuda will be refused when this is no dry run. On GPUs {shared}; {together}"
    return f"{len(place.gpus)} GPU{'s' * (len(place.gpus) > 1)} ({listed(place.gpus)}), {shared}; {together}; {cores}"


def changes(files: Sequence[Path]) -> list[str]:
    """A line per file of --configfile behind the first: keys whose value it changes, from what to what. Raises InputError.

    A key that no earlier file names has the program's default before.
    """
    lines, before = [], plain(Config())
    for place, file in enumerate(map(Path, files)):
        values = read_yaml(file)
        if place:
            old, new = flat(before), flat(values)
            changed = [f"{key} {_short(old.get(key))} -> {_short(value)}" for key, value in new.items() if old.get(key) != value]
            rest = f" and {len(changed) - MOST_CHANGES} more" if len(changed) > MOST_CHANGES else ""
            what = f"changes {'; '.join(changed[:MOST_CHANGES])}{rest}" if changed else "changes nothing"
            lines.append(f"{file.name}, behind {', '.join(Path(one).name for one in files[:place])}, {what}")
        merge(before, values)
    return lines


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_CHANGE else f"{text[: LONGEST_CHANGE - 3]}..."
