"""The plan of a run, before its first job: missing data, what is made again and why, hours, devices, tables, overlays of settings.

Hours come from the finished jobs of the results folder, where there are any of the rule, else from `SECONDS`.
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
"""Changes of settings in a line, and characters of a value."""
MOST_RECORDS = 20
"""Records of a rule that are read for its time."""
SECONDS: dict[tuple[str, str], float] = {
    **{("capture", "cpu"): 60, ("segment", "cpu"): 7, ("track", "cpu"): 5, ("lift", "cpu"): 15, ("judge", "cpu"): 2},
    **{("search", "cpu"): 12.8 / 88, ("search", "gpu"): 12 * 60 / 220, ("fit", "cpu"): 27.8 / 20, ("fit", "gpu"): 5 * 60 / 200},
    **{("observe", "cpu"): 1.3, ("rollout", "cpu"): 1.4, ("rollout", "gpu"): 3.3, ("score", "cpu"): 2.9, ("render", "cpu"): 8.9},
    **{("appearance", "cpu"): 46.1 / 300, ("tables", "cpu"): 3, ("page", "cpu"): 6},
}
"""Stage and device -> s per unit of work. CPU: `make demo` (300 nodes, 45 frames) on two vCPUs of an AMD EPYC. GPU: PhysTwin's
README, one stuffed animal on an RTX 4090."""
WORK_UNITS: dict[str, Callable[[Config], int]] = {
    "search": lambda config: config.search.rollouts,
    "fit": lambda config: config.fit.epochs,
    "appearance": lambda config: config.images.appearance.iterations,
}
"""Stage -> units of work; 1 for others."""


def told(graph: Graph, todo: Sequence[Unit], files: Sequence[Path], *, gpus: Sequence[str], cores: int, cluster: bool) -> str:
    """A dozen lines at most; none where nothing is to be done. `todo`: jobs; `files`: those of --configfile, in order."""
    known = graph.benchmark
    if not (todo or known.absent):
        return ""
    lines = [f"missing  {known.absent} A run stops before its first job."] if known.absent else []
    large = [Path(known.data_path(name) or "", file) for name in known.scenarios for file in known.source(name).needed]
    seen = Counter(path.name for path in large if path.suffix != ".json" and path.exists())
    lines += [f"data     {file} of {count} scenarios exists; only jobs read it" for file, count in seen.items()]
    counts = Counter(unit.rule for unit in todo)
    lines += [f"jobs     {len(todo):,}: {', '.join(f'{rule} {count:,}' for rule, count in counts.items())}"]
    lines += [f"time     {line}" for line in _times(graph, todo, len(gpus), 0 if cluster else cores)]
    where = f"GPU {listed(gpus)}, {graph.config.gpus.jobs_per_gpu} job(s) on each" if gpus else "no GPU"
    if known.on_gpu and not gpus:
        where = "there is no GPU here: device: cuda is refused when this is no dry run"
    lines += [f"devices  {'those of the cluster' if cluster else f'{cores} cores; {where}'}"]
    studies = f", studies/ ({listed(graph.config.studies)})" if graph.config.studies else ""
    lines += [f"tables   {graph.results}/{graph.config.tables}/summary.md, report.html{studies}"]
    lines += [f"settings {line}" for line in overlays(files)] + [f"again    {line}" for line in replaced(graph, todo)]
    return "\n".join(["Plan:", *(f"  {line}" for line in lines), ""])


def _times(graph: Graph, todo: Sequence[Unit], gpus: int, cores: int) -> Iterable[str]:
    """A line per kind of device."""
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
            shared = f", {duration(total / places)} on {places} of them" if places > 1 else ""
            source = "; ".join(dict.fromkeys(source for (_, of), (_, source) in known.items() if of == kind))
            yield f"{duration(total)} of one {kind.upper()}{shared}: {parts} (by {source})"


def _seconds(graph: Graph, unit: Unit, kind: str) -> tuple[float, str]:
    """Seconds that a unit takes, and what says so."""
    folder, found = Path(graph.results) / FOLDER / unit.rule, list[float]()
    for path in itertools.islice(folder.rglob("*.json"), MOST_RECORDS):
        try:
            record = JobRecord.load(path)
        except InputError:
            continue
        if record.outcome == "ok" and bool(record.devices) == (kind == "gpu") and record.made_of:
            found.append(record.seconds)
    if found:
        return statistics.median(found), "jobs of this folder"
    names = [step.stage.name for step in unit.steps] or [unit.rule]
    config = graph.rows(unit.steps[0].job).config if unit.steps else graph.config
    seconds = [
        SECONDS.get((name, kind), SECONDS.get((name, "cpu"), 0.0)) * WORK_UNITS.get(name, lambda _: 1)(config) for name in names
    ]
    return sum(seconds), "one stuffed animal on an RTX 4090" if kind == "gpu" else "make demo"


def replaced(graph: Graph, todo: Sequence[Unit]) -> list[str]:
    """Lines on results that are made again, and what differs from what they were made of."""
    groups: dict[tuple[str, tuple[str, ...]], int] = defaultdict(int)
    for unit in [member for job in todo for member in job.members or (job,)]:
        for path in graph.folder(unit).glob("*.json"):
            try:
                before = JobRecord.load(path).made_of
            except InputError:
                continue
            if before and path != graph.record(unit):
                groups[unit.rule, tuple(_differences(before, unit.made_of))] += 1
    keep = ["Results are replaced. To keep them, use another folder: --config results=..."] if groups else []
    return [f"{rule} ({count}): {listed(changes, MOST_CHANGES)}" for (rule, changes), count in groups.items()] + keep


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterable[str]:
    def read(made: Mapping[str, Any]) -> dict[str, Any]:
        steps = {step: dict(values) for step, values in made.items()}
        for values in steps.values():
            values |= json.loads(values.pop("settings", "{}"))
        return flat({step.partition("/")[0]: values for step, values in steps.items()})

    # As records keep them: tuples are lists there.
    old, new = read(before), read(json.loads(json.dumps(after, default=str)))
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    for name in sorted(changed, key=lambda name: ".inputs" in name):
        hashed = name.rpartition(".")[2] == "code" or ".inputs" in name or ".data" in name
        yield name if hashed else f"{name} {_short(old.get(name))} -> {_short(new.get(name))}"


def overlays(files: Sequence[Path]) -> list[str]:
    """A line per file of --configfile behind the first: keys whose value it changes, from what to what. Raises InputError."""
    lines, before = [], plain(Config())
    for place, file in enumerate(map(Path, files)):
        values = read_yaml(file)
        if place:
            old = flat(before)
            changed = [f"{k} {_short(old.get(k))} -> {_short(v)}" for k, v in flat(values).items() if old.get(k) != v]
            lines.append(f"{file.name} changes {listed(changed, MOST_CHANGES) or 'nothing'}")
        merge(before, values)
    return lines


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."
