"""Which results are stale (out of date): each stage's record against the settings, the code and the inputs of today.

Records travel with the results folder. What Snakemake remembers in `.snakemake` does not: there a folder that was renamed, or whose
`.snakemake` was deleted, counts as finished whatever is asked for.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord
from neuspring.core.provenance import code_digest
from neuspring.core.records import RECORD_FORMAT, digest_file, read_json
from neuspring.core.run_record import flat
from neuspring.experiments.graph import Graph
from neuspring.stages import STAGES
from neuspring.stages.stage import Stage

IMAGES = "images"
"""The input that stands for all images of a capture."""
LONGEST_VALUE, MOST_DEPARTURES = 40, 6
"""Characters shown of a value, and departures shown of a group of jobs."""


class Freshness:
    """Compares the records of a results folder with what a graph's jobs would make now."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.departures: dict[str, tuple[str, ...]] = {}
        """Output of a job that was looked at -> how what is there departs from what would be made; nothing: not at all."""
        self._digest = functools.cache(digest_file)

    def look(self, stage: Stage, job: Any) -> tuple[str, ...]:
        """Departures of what is there of a job from what it would make now; nothing where it does not, or nothing is there."""
        output = self.graph.output_of(stage, job)
        if output not in self.departures:
            there = Path(output).exists()
            find = self._of_shared if stage.together else self._of_record
            self.departures[output] = tuple(find(stage, job, Path(output))) if there else ()
        return self.departures[output]

    def of_runs(self) -> list[str]:
        """Lines on the runs of the configuration that are there but were made with something else; none if there are none."""
        found: dict[str, tuple[str, str, tuple[str, ...]]] = {}
        for path in self.graph.runs():
            run = SimpleNamespace(**dict(zip(("scenario", "method", "seed"), Path(path).parts[-4:-1], strict=True)))
            for stage, job in self.graph.behind(STAGES["score"], run) if Path(path).exists() else ():
                if departures := self.look(stage, job):
                    row = getattr(job, next((name for name in stage.wildcards if name in ("method", "search")), ""), "")
                    found[self.graph.output_of(stage, job)] = (stage.name, row, departures)
        return told(found.values())

    def _of_record(self, stage: Stage, job: Any, output: Path) -> Iterator[str]:
        try:
            record = read_json(stage.record_of(output), RECORD_FORMAT)
            maker, settings, inputs = record["stage"], record["settings"], dict(record["inputs"])
        except (InputError, KeyError, TypeError, ValueError):
            yield "no record of how it was made"
            return
        if maker != stage.name:
            yield f"made by {maker}"
        before, now = (flat(values) for values in (settings, self.graph.recorded(stage, job)))
        # A name of its own that only the record has was found by the stage, such as `oracle`; one in a section was a setting.
        gone = [name for name in before if name not in now and "." in name]
        for name in [*now, *gone]:
            if name not in before or name not in now or before[name] != now[name]:
                yield f"{name} {_short(before.get(name))} -> {_short(now.get(name))}"
        if record.get("code", "") != self.graph.code(stage, job):
            yield "code" if record.get("code") else "code (an older version)"
        for role, path in self._roles(stage, job).items():
            digest = inputs.pop(role, None)
            # What is not there will be made, and then this is made again too.
            if Path(path).exists() and self._digest(Path(path)) != digest:
                yield f"input {role}"
        images, wanted = inputs.pop(IMAGES, ""), self.graph.rows(job).image_stamps if "capture" in stage.inputs else ""
        if wanted and images != wanted:
            yield "images"
        yield from (f"input {role}, which is no longer read" for role in inputs)

    def _of_shared(self, stage: Stage, job: Any, output: Path) -> Iterator[str]:
        """Its checkpoints are of use to jobs that are still to be done; it makes no result of its own."""
        assert stage.together
        other = STAGES[stage.together.stage]
        for member in self.graph.in_step(stage, job):
            if self.look(other, member) or not Path(self.graph.output_of(other, member)).exists():
                yield f"its {stage.name} are not finished"
                return

    def _roles(self, stage: Stage, job: Any) -> Mapping[str, str]:
        """The input files of a job by their names in its record."""
        found = self.graph.inputs(stage)(job)
        roles: dict[str, str] = {}
        for name, parameter in stage.inputs.items():
            files = found.get(name, [])
            for place, path in enumerate([files] if isinstance(files, str) else files):
                roles[f"{name}{place}" if parameter.many else name] = path
        return roles


def told(changed: Iterable[tuple[str, str, tuple[str, ...]]]) -> list[str]:
    """A line per rule and departures, of (rule, method or search, departures): what differs, and in how many jobs."""
    groups: dict[tuple[str, tuple[str, ...]], list[str]] = defaultdict(list)
    for rule, row, departures in changed:
        groups[rule, departures].append(row)
    lines = []
    for (rule, departures), rows in groups.items():
        named = ", ".join(dict.fromkeys(filter(None, rows)))
        shown = [
            *departures[:MOST_DEPARTURES],
            *([f"{len(departures) - MOST_DEPARTURES} more"] if len(departures) > MOST_DEPARTURES else []),
        ]
        jobs = f"{len(rows)} job{'s' * (len(rows) > 1)}"
        lines.append(f"  {rule} ({', '.join(filter(None, [named, jobs]))}): {', '.join(shown)}")
    return lines


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


def stamp_of(results: str, root: Path, told: Iterable[str], *modules: str) -> str:
    """A digest of what a job of no stage is told, wherever results and project `root` lie, and of the code of its modules."""
    # As a path of its own, and as a setting in JSON; before the root, in which the results may lie.
    words = [re.sub(rf"^{re.escape(results)}(?=/|$)", ".", word.replace(f": {json.dumps(results)}", ': "."')) for word in told]
    words = [word.replace(f"{root}/", "") for word in words]
    return hashlib.sha256(json.dumps([words, code_digest(*modules)]).encode()).hexdigest()[:16]


def stamped(results: Path, log: Path, stamp: str) -> bool:
    """True if the last job with this log succeeded with this stamp."""
    try:
        return JobRecord.load(JobRecord.of_log(results, log).path(results)).stamp == stamp
    except InputError:
        return False
