"""Observations -> coarse twin, by CMA-ES and a polish."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from neuspring.config import Body, Config, Search
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder
from neuspring.stages.stage import Rows, Written, stage

if TYPE_CHECKING:
    import pandas as pd

READS = ("search", "simulation", "losses", "released_quirks")
SURFACES = ("ground_", "contact_")
"""How the names of variables begin that have no effect where nothing touches."""
END = 0.01
"""Distance from an end of its range, in normalized units, within which a variable counts as held by it."""


def _settled(rows: Rows) -> Config:
    """The configuration; a body of one region has none to tie."""
    if rows.search is None or rows.search.clusters > 1:
        return rows.config
    return dataclasses.replace(rows.config, search=dataclasses.replace(rows.config.search, tied_rollouts=Search().tied_rollouts))


@stage(
    output="{scenario}/search-{search}/{seed}/search.json",
    reads=lambda settings, given: (*READS, *(("rod", "fit.rod") if given["body"] == "rod" else ())),
    gpu=True,
    memory_mb=8000,
    minutes=240,
    when=lambda rows: rows.search is not None,
    given=lambda rows: {"clusters": rows.search.clusters, "body": rows.search.body} if rows.search else {},
    settled=_settled,
)
def search(
    observations: Observations,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations] = (),
    leave_out: bool = False,
    clusters: int = 1,
    body: Body = "lattice",
    seed: int = 0,
    device: str = "auto",
    threads: int = 1,
    twins_per_launch: int | Literal["auto"] = "auto",
) -> Written:
    """Observations -> coarse twin, by CMA-ES: twin.npz, trace.parquet (every candidate with cost and variables), history.parquet.

    `clusters` regions of the topology have values of their own (1: uniform). At most `twins_per_launch` candidates share a launch
    (auto: as many as pay), and `threads` launches run at the same time on a CPU; neither changes a number there. A trace of the
    same search is continued, so a larger `search.rollouts` costs only the difference. With a `pool` of other recordings a
    candidate's cost is the mean over all; with `leave_out`, over those alone. A `body` that is a rod has no topology to search: its
    constants are found by Levenberg-Marquardt on the first frames (twin/rod_fit.py).
    """
    from neuspring.core.checkpoint import checkpoint_key
    from neuspring.core.files import write_history
    from neuspring.twin.candidates import CMAES, Recording, SearchProblem
    from neuspring.twin.polish import SLOPES
    from neuspring.twin.search import search as search_twin

    if threads < 1:
        raise InputError("--threads", "must be at least 1", threads)
    if body == "rod":
        return _rod(observations, settings, run, pool, leave_out, device, threads)
    shared = (settings.simulation, settings.losses, settings.released_quirks, device)
    problem = SearchProblem(
        observations,
        settings.search,
        *shared,
        clusters,
        launch_size(twins_per_launch),
        threads,
        tuple(Recording.of(other, *shared) for other in pool),
        leave_out,
    )
    # The budget is not part of the key: a search with a larger one begins with the same candidates.
    without_budget = {name: value for name, value in run.settings["search"].items() if name != "rollouts"}
    key = checkpoint_key(run.inputs, run.settings | {"search": without_budget}, device, "neuspring.twin.search")
    files = run.beside(twin="twin.npz", trace="trace.parquet", history="history.parquet")
    result = search_twin(problem, seed, record=files["trace"], key=key)
    result.twin.save(files["twin"])
    costs = result.trace["cost"]
    # Candidates for slopes are never the result.
    best = costs.where(result.trace["stage"] != SLOPES).cummin().ffill()
    write_history(costs.index, {"cost": costs, "best_cost": best}, files["history"])
    facts: dict[str, Any] = {
        **result.values,
        "hands": "push" if result.twin.topology.pushes.any() else "hold",
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
    return Written(files=files, facts=facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds)


def _rod(
    observations: Observations,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations],
    leave_out: bool,
    device: str,
    threads: int,
) -> Written:
    """The search of a rod; files as of a lattice."""
    from neuspring.core.files import write_history, write_table
    from neuspring.twin.rod_fit import search_rod
    from neuspring.twin.transfer import require_pool

    require_pool(observations, pool, leave_out)
    files = run.beside(twin="twin.npz", trace="trace.parquet", history="history.parquet")
    result = search_rod(observations, pool, settings, leave_out=leave_out, device=device, threads=threads)
    result.twin.save(files["twin"])
    write_table(result.history, files["trace"])
    costs = result.history["loss"]
    write_history(costs.index, {"cost": costs, "best_cost": costs.cummin()}, files["history"])
    facts = {"cost": result.value, "rollouts": result.rollouts, "collision_overflow": 0, **result.facts, **result.twin.counts}
    return Written(files=files, facts=facts)


def launch_size(twins_per_launch: int | Literal["auto"]) -> int:
    """How many twins share a launch at most; 0: as many as pay. Raises InputError."""
    if twins_per_launch == "auto":
        return 0
    if not isinstance(twins_per_launch, int) or twins_per_launch < 1:
        raise InputError("--twins-per-launch", "must be auto or an integer of at least 1", twins_per_launch)
    return twins_per_launch


def at_ends(trace: pd.DataFrame, variables: Sequence[str]) -> list[str]:
    """Variables of the best candidate that lie within `END` of an end of their range; contact is left out."""
    from neuspring.twin.polish import SLOPES

    judged = trace[trace["stage"] != SLOPES]
    best = judged.iloc[int(judged["cost"].to_numpy().argmin())]
    decisive = [name for name in variables if not name.startswith(SURFACES)]
    return [name for name in decisive if not END <= best[f"normalized.{name}"] <= 1 - END]
