"""Processor time of runs of the workflow, by groups of stages, from the records of jobs.

Of a job, only the last successful attempt counts. Of a launch of several fits (rule `fits`) each has the share that its record
says, in time that passed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring.core.job_records import read_jobs
from neuspring.core.records import StageRecord, digest_file
from neuspring.core.text import markdown
from tests.benchmarks.beside_data import Run
from tests.benchmarks.beside_tables import in_order

GROUPS = {
    "perception": ("capture", "segment", "track", "lift", "judge", "observe"),
    "search": ("search",),
    "fit": ("fits", "fit", "train"),
    "pictures": ("appearance", "render"),
    "rest": ("rollout", "predict", "score", "transfer"),
}
"""Rules of the workflow by what they are for."""
COSTED = "neuspring"
"""Whose cost is shown by scenario."""
UPSTREAM = ("search", "fit", "train", "appearance")
"""Inputs of records that are records of other jobs."""


def group_of(rule: str) -> str:
    """The group of a rule."""
    return next((group for group, rules in GROUPS.items() if rule in rules), "rest")


def minutes_by_job(results: Path) -> dict[str, float]:
    """Processor minutes by the name of a job; jobs that never succeeded are left out."""
    found = {}
    for record in read_jobs(results, damaged=[]):
        good = [attempt for attempt in record.attempts if attempt.outcome == "ok"]
        if good:
            found[record.name] = good[-1].cpu_seconds / 60
    return found


def records_of(scenario: Path) -> dict[str, Path]:
    """Paths of the stage records of a scenario that other stages read, by digest."""
    return {digest_file(path): path for name in UPSTREAM for path in sorted(scenario.glob(f"*/*/{name}.json"))}


def jobs_of_run(run: Run, known: Mapping[str, Path]) -> set[str]:
    """Names that the jobs of a run may have, perception left out.

    Records name their inputs by digest. From the records beside run.json they lead to the search, the fit and the splats.
    """
    waiting = [path for name in ("rollout", "render", "fit", "train") if (path := run.folder / f"{name}.json").is_file()]
    visited: set[Path] = set()
    jobs = {f"{rule}/{run.scenario.name}/{run.method}/{run.seed}" for rule in ("rollout", "predict", "score")}
    while waiting:
        path = waiting.pop()
        if path in visited:
            continue
        visited.add(path)
        # A folder search-NAME belongs to the row NAME of searches.yaml.
        folder = path.parent.parent.name.removeprefix("search-") if path.stem == "search" else path.parent.parent.name
        jobs.add(f"{path.stem}/{run.scenario.name}/{folder}/{path.parent.name}")
        inputs = StageRecord.load(path).inputs
        waiting += [known[digest] for role, digest in inputs.items() if role in UPSTREAM and digest in known]
    return jobs


def together(path: Path) -> float:
    """Minutes of a fit that ran together with others, its share of the launch; 0 of one that ran alone."""
    record = StageRecord.load(path) if path.is_file() else None
    return record.seconds / 60 if record and record.facts.get("epochs_together") else 0.0


def costs(results: Path, runs: Sequence[Run]) -> pd.DataFrame:
    """Processor minutes of every run: columns scenario, method, seed, group, minutes. What runs share counts in each of them."""
    minutes, rows = minutes_by_job(results), []
    for scenario in dict.fromkeys(run.scenario for run in runs):
        known = records_of(scenario)
        seen = {name: value for name, value in minutes.items() if _scenario(name) == scenario.name}
        perception = sum(value for name, value in seen.items() if group_of(_rule(name)) == "perception")
        for run in (run for run in runs if run.scenario == scenario):
            own = jobs_of_run(run, known)
            identity = {"scenario": scenario.name, "method": run.method, "seed": run.seed}
            rows.append(identity | {"group": "perception", "minutes": perception})
            for group in (group for group in GROUPS if group != "perception"):
                total = sum(value for name, value in seen.items() if name in own and group_of(_rule(name)) == group)
                shared = together(run.folder / "fit.json") if group == "fit" else 0.0
                rows.append(identity | {"group": group, "minutes": max(total, shared)})
    return pd.DataFrame(rows, columns=["scenario", "method", "seed", "group", "minutes"])


def merged(costs: pd.DataFrame, earlier: pd.DataFrame) -> pd.DataFrame:
    """Costs, and those of an earlier call of runs that these do not have; by scenario, and methods in the order of methods.yaml."""
    names = ["scenario", "method", "seed"]
    there = set(costs[names].itertuples(index=False, name=None))
    rest = [row not in there for row in earlier[names].itertuples(index=False, name=None)]
    both = pd.concat([costs, earlier[rest]], ignore_index=True)
    order = in_order(both["method"])
    return both.sort_values(names, key=lambda column: column.map(order.index) if column.name == "method" else column, kind="stable")


def cost_lines(table: pd.DataFrame) -> list[str]:
    """Tables of processor minutes of one run, mean over its seeds: by method, and of COSTED by scenario, or of the last method."""
    if not len(table):
        return []
    lines = ["", "## Cost: processor minutes of one run", ""]
    lines += ["Mean over runs. What runs share (perception, a search, splats) counts in each of them.", ""]
    lines += markdown(["method", "runs", *GROUPS, "sum"], _minutes(table, "method"))
    shown = COSTED if (table["method"] == COSTED).any() else table["method"].iloc[-1]
    lines += ["", f"The same of `{shown}`, by scenario:", ""]
    lines += markdown(["scenario", "runs", *GROUPS, "sum"], _minutes(table[table["method"] == shown], "scenario"))
    return lines


def _minutes(table: pd.DataFrame, by: str) -> list[list[str]]:
    """Rows of text: a name, how many runs it has, minutes of each group and their sum."""
    wide = table.pivot_table(index=by, columns="group", values="minutes", sort=False).reindex(columns=list(GROUPS))
    counts = table.groupby(by)[["scenario", "method", "seed"]].apply(lambda part: len(part.drop_duplicates()))
    return [
        [str(name), str(counts[name]), *("–" if np.isnan(v) else f"{v:.1f}" for v in row), f"{row.sum():.1f}"]
        for name, row in wide.iterrows()
    ]


def _rule(job: str) -> str:
    return job.split("/")[0]


def _scenario(job: str) -> str:
    parts = job.split("/")
    return parts[1] if len(parts) > 1 else ""
