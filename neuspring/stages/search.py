"""Observations -> coarse twin, by CMA-ES and a polish."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.config import Config
from neuspring.config.select import select
from neuspring.core.artifacts import Observations
from neuspring.core.checkpoint import checkpoint_key
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_history
from neuspring.core.records import Recorder
from neuspring.stages import STAGES
from neuspring.stages import options as shared
from neuspring.twin.polish import CMAES, SLOPES
from neuspring.twin.recordings import Recording
from neuspring.twin.search import SearchProblem, search

SURFACES = ("ground_", "contact_")
"""How the names of variables begin that have no effect where nothing touches."""
END = 0.01
"""Distance from an end of its range, in normalized units, within which a variable counts as held by it."""


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring search`."""
    shared.add_observations(parser)
    shared.add_pool(parser)
    shared.add_settings(parser)
    parser.add_argument("--clusters", type=int, default=1, help="regions of the topology with values of their own (1: uniform)")
    shared.add_seed(parser)
    shared.add_device(parser)
    shared.add_twins_per_launch(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring search`."""
    together = shared.read_twins_per_launch(a)
    run(
        a.observations,
        shared.read_settings(a.settings),
        a.clusters,
        a.seed,
        a.device,
        a.output,
        together,
        a.threads,
        a.pool,
        a.leave_out,
    )


def run(
    observations_path: Path,
    settings: Config,
    clusters: int,
    seed: int,
    device: str,
    output: Path,
    together: int = 0,
    threads: int = 1,
    pool: Sequence[Path] = (),
    leave_out: bool = False,
) -> None:
    """Write twin.npz, trace.parquet (every candidate with its cost and variables), history.parquet, and the record `output`.

    At most `together` candidates share a launch (0: as many as pay), and `threads` launches run at the same time on a CPU; neither
    changes a number there. A trace of the same search is continued, so a larger `search.rollouts` costs only the difference.
    With a `pool` of other recordings' observations a candidate's cost is the mean over all; with `leave_out`, over those alone.
    """
    if threads < 1:
        raise InputError("--threads", "must be at least 1", threads)
    device = resolve_device(device)
    values = select(settings, STAGES["search"].reads)
    record = Recorder(
        "search",
        output,
        inputs={"observations": observations_path} | shared.pool_inputs(pool),
        settings=values | {"clusters": clusters, "seed": seed} | ({"leave_out": True} if leave_out else {}),
        device=device,
    )
    problem = SearchProblem(
        Observations.load(observations_path),
        settings.search,
        settings.simulation,
        settings.losses,
        settings.released_quirks,
        device,
        clusters,
        together,
        threads,
        tuple(
            Recording.of(Observations.load(path), settings.simulation, settings.losses, settings.released_quirks, device)
            for path in pool
        ),
        leave_out,
    )
    # The budget is not part of the key: a search with a larger one begins with the same candidates.
    without_budget = {name: value for name, value in values["search"].items() if name != "rollouts"}
    key = checkpoint_key(record.inputs, record.settings | {"search": without_budget}, device, "neuspring.twin.search")
    files = record.beside(twin="twin.npz", trace="trace.parquet", history="history.parquet")
    try:
        result = search(problem, seed, record=files["trace"], key=key)
    except NumericalFailure as failure:
        record.save(failure=str(failure))
        return
    result.twin.save(files["twin"])
    costs = result.trace["cost"]
    # Candidates for slopes are never the result.
    best = costs.where(result.trace["stage"] != SLOPES).cummin().ffill()
    write_history(costs.index, {"cost": costs, "best_cost": best}, files["history"])
    facts: dict[str, Any] = {
        **result.values,
        "cost": result.cost,
        "cost_before_polish": float(costs[result.trace["stage"] == CMAES].min()),
        "spacing": problem.spacing,
        "controller_reach": problem.reach,
        "rollouts": len(result.trace),
        "failed_rollouts": int((result.trace["reason"] != "").sum()),
        "collision_overflow": int(result.trace["collision_overflow"].max()),
        "spring_updates": int((result.trace["springs"] * result.trace["substeps"]).sum()) * problem.simulated_frames,
        **result.twin.counts,
    }
    if held := at_ends(result.trace, problem.variables):
        facts["at_ends"] = ", ".join(held)
    record.save(files, facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds)


def at_ends(trace: pd.DataFrame, variables: Sequence[str]) -> list[str]:
    """Variables of the best candidate that lie within `END` of an end of their range; contact is left out."""
    judged = trace[trace["stage"] != SLOPES]
    best = judged.iloc[int(judged["cost"].to_numpy().argmin())]
    decisive = [name for name in variables if not name.startswith(SURFACES)]
    return [name for name in decisive if not END <= best[f"normalized.{name}"] <= 1 - END]
