"""The plan of a run, before its first job: missing data, jobs, hours, devices, tables, overrides, and repeated jobs with reasons.

Times come from finished jobs of the same rule in the results folder; without such jobs, from `SECONDS`.
"""

from __future__ import annotations

import itertools
import json
import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuspring.config import Config, merge, plain
from neuspring.config.parse import read_yaml
from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER, JobRecord
from neuspring.core.run_record import flat
from neuspring.core.text import duration, listed
from neuspring.experiments.graph import Graph, Unit

MOST_CHANGES, LONGEST_VALUE = 6, 60
"""Maximum number of changed settings in a line, and of characters of a value."""
MOST_RECORDS = 20
"""Maximum number of records that are read for the time of a rule."""
SECONDS: dict[tuple[str, str], float] = {
    **{("capture", "cpu"): 60, ("segment", "cpu"): 7, ("track", "cpu"): 5, ("lift", "cpu"): 15, ("judge", "cpu"): 2},
    **{("search", "cpu"): 12.8 / 88, ("search", "gpu"): 12 * 60 / 220, ("fit", "cpu"): 27.8 / 20, ("fit", "gpu"): 5 * 60 / 200},
    **{("observe", "cpu"): 1.3, ("rollout", "cpu"): 1.4, ("rollout", "gpu"): 3.3, ("score", "cpu"): 2.9, ("render", "cpu"): 8.9},
    **{("appearance", "cpu"): 46.1 / 300, ("tables", "cpu"): 3, ("page", "cpu"): 6},
}
"""(stage, device) -> s per unit of work. CPU: measured with `make demo` (300 nodes, 45 frames) on two vCPUs of an AMD EPYC. GPU:
stated in PhysTwin's README for one stuffed animal on an RTX 4090."""
WORK_UNITS: dict[str, Callable[[Config], int]] = {
    "search": lambda config: config.search.rollouts,
    "fit": lambda config: config.fit.epochs,
    "appearance": lambda config: config.images.appearance.iterations,
}
"""Stage -> units of work; 1 for all other stages."""


def summary(graph: Graph, todo: Sequence[Unit], files: Sequence[Path], *, gpus: Sequence[str], cores: int, cluster: bool) -> str:
    """The plan as text, at most a dozen lines; empty if there is nothing to do.

    `todo`: the jobs; `files`: the files of --configfile, in order.
    """
    known = graph.benchmark
    if not (todo or known.absent):
        return ""
    lines = [f"missing  {known.absent} A run stops before its first job."] if known.absent else []
    large = [Path(known.data_path(name) or "", file) for name in known.scenarios for file in known.source(name).needed]
    existing = Counter(path.name for path in large if path.suffix != ".json" and path.exists())
    lines += [f"data     {file} exists for {count} scenarios; its content is not checked yet" for file, count in existing.items()]
    counts = Counter(unit.rule for unit in todo)
    lines += [f"jobs     {len(todo):,}: {', '.join(f'{rule} {count:,}' for rule, count in counts.items())}"]
    lines += [f"time     {line}" for line in _times(graph, todo, len(gpus), 0 if cluster else cores)]
    where = f"GPU {listed(gpus)}, {graph.config.gpus.jobs_per_gpu} job(s) on each" if gpus else "no GPU"
    if known.on_gpu and not gpus:
        where = "no GPU on this machine, so a run with device: cuda stops here"
    lines += [f"devices  {'assigned by the cluster' if cluster else f'{cores} cores; {where}'}"]
    studies = f", studies/ ({listed(graph.config.studies)})" if graph.config.studies else ""
    lines += [f"tables   {graph.results}/{graph.config.tables}/summary.md, report.html{studies}"]
    lines += [f"settings {line}" for line in overlays(files)] + [f"repeated {line}" for line in replaced(graph, todo)]
    return "\n".join(["Plan:", *(f"  {line}" for line in lines), ""])


def _times(graph: Graph, todo: Sequence[Unit], gpus: int, cores: int) -> Iterable[str]:
    """Yield one line per kind of device."""
    known: dict[tuple[str, str], tuple[float, str]] = {}
    times: dict[str, Counter[str]] = {"gpu": Counter(), "cpu": Counter()}
    for unit in todo:
        kind, count = "gpu" if graph.gpus(unit) else "cpu", len(unit.members) or 1
        if (unit.rule, kind) not in known:
            known[unit.rule, kind] = _seconds(graph, (unit.members or (unit,))[0], kind)
        times[kind][unit.rule] += round(1000 * count * known[unit.rule, kind][0])
    for (kind, spent), places in zip(times.items(), (gpus, cores), strict=True):
        if total := spent.total() / 1000:
            parts = ", ".join(f"{rule} {duration(ms / 1000)}" for rule, ms in spent.most_common(4))
            shared = f", {duration(total / places)} on {places}" if places > 1 else ""
            source = "; ".join(dict.fromkeys(source for (_, of), (_, source) in known.items() if of == kind))
            yield f"{duration(total)} on one {kind.upper()}{shared}: {parts} (from {source})"


def _seconds(graph: Graph, unit: Unit, kind: str) -> tuple[float, str]:
    """The duration of a unit, s, and the source of this number."""
    folder, measured = Path(graph.results) / FOLDER / unit.rule, list[float]()
    for path in itertools.islice(folder.rglob("*.json"), MOST_RECORDS):
        try:
            record = JobRecord.load(path)
        except InputError:
            continue
        if record.outcome == "ok" and bool(record.devices) == (kind == "gpu") and record.made_of:
            measured.append(record.seconds)
    if measured:
        return statistics.median(measured), "finished jobs"
    names = [step.stage.name for step in unit.steps] or [unit.rule]
    config = graph.rows(unit.steps[0].job).config if unit.steps else graph.config
    seconds = [
        SECONDS.get((name, kind), SECONDS.get((name, "cpu"), 0.0)) * WORK_UNITS.get(name, lambda _: 1)(config) for name in names
    ]
    return sum(seconds), "one stuffed animal on an RTX 4090" if kind == "gpu" else "make demo"


def replaced(graph: Graph, todo: Sequence[Unit]) -> list[str]:
    """Lines on repeated jobs, with the changes of their settings, code and inputs."""
    groups: dict[tuple[str, tuple[str, ...]], int] = defaultdict(int)
    for unit in [member for job in todo for member in job.members or (job,)]:
        for path in graph.folder(unit).glob("*.json"):
            try:
                before = JobRecord.load(path).made_of
            except InputError:
                continue
            if before and path != graph.record(unit):
                groups[unit.rule, tuple(_differences(before, unit.made_of))] += 1
    keep = ["old results are replaced; to keep them, use another folder: --config results=..."] if groups else []
    return [f"{rule} ({count}): {listed(changes, MOST_CHANGES)}" for (rule, changes), count in groups.items()] + keep


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterable[str]:
    def read(made: Mapping[str, Any]) -> dict[str, Any]:
        steps = {step: dict(values) for step, values in made.items()}
        for values in steps.values():
            values |= json.loads(values.pop("settings", "{}"))
        return flat({step.partition("/")[0]: values for step, values in steps.items()})

    # JSON turns tuples into lists, as in records.
    old, new = read(before), read(json.loads(json.dumps(after, default=str)))
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    for name in sorted(changed, key=lambda name: ".inputs" in name):
        hashed = name.rpartition(".")[2] == "code" or ".inputs" in name or ".data" in name
        yield name if hashed else f"{name} {_short(old.get(name))} -> {_short(new.get(name))}"


def overlays(files: Sequence[Path]) -> list[str]:
    """One line for every file of --configfile after the first: the changed keys with old and new values. Raises InputError."""
    lines, before = [], plain(Config())
    for index, file in enumerate(map(Path, files)):
        values = read_yaml(file)
        if index:
            old = flat(before)
            changed = [f"{k} {_short(old.get(k))} -> {_short(v)}" for k, v in flat(values).items() if old.get(k) != v]
            lines.append(f"{file.name} changes {listed(changed, MOST_CHANGES) or 'nothing'}")
        merge(before, values)
    return lines


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."
