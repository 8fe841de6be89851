"""Candidates of the search: variables, the twin that follows from them, and its cost on all recordings.

Variables are normalized to [0, 1] by their ranges. A piecewise topology of K regions has 2K + 10 variables, without those in
`search.fixed`. The search builds a twin per candidate and rolls it out over the training frames (trials.py). The cost is the mean
training loss (losses.py).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from neuspring import config
from neuspring.config.search import LENGTHS, VARIABLES
from neuspring.core.artifacts import Observations, Simulation, Twin
from neuspring.core.errors import NumericalFailure
from neuspring.physics import stability
from neuspring.physics.controllers import waypoints
from neuspring.physics.lanes import LANE_WIDTH
from neuspring.physics.parameters import homogeneous
from neuspring.physics.topology import controller_reach, node_spacing, piecewise_topology, regions
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import initial_velocity
from neuspring.twin.transfer import move, require_pool
from neuspring.twin.trials import Outcome, Rollouts

INTEGERS = ("object_neighbors", "controller_neighbors")
REGIONAL = ("object_radius", "object_neighbors")
"""Variables with one value per region."""
PENALTY = 1e6
"""Cost of a candidate that diverges or cannot be integrated; far above any loss in m^2."""
UNSTABLE = "unstable"
"""Prefix of the reason of a candidate that a fixed number of substeps cannot integrate."""
CMAES, OTHER_WAY = "cmaes", "hands"
"""Stages in the trace: candidates of CMA-ES, and its first generation with the rejected mode of controllers (`search.hands`)."""
Map = Callable[..., Iterable[Any]]
"""A function like the builtin `map`."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """The training frames of a recording: controllers, start velocity, and losses."""

    observations: Observations
    hands: torch.Tensor
    """Waypoints of the controllers (controllers.py), [train_end, C, 3], m."""
    velocity: torch.Tensor
    """Velocity of the nodes in frame 0 [N, 3], m/s."""
    loss: FrameLoss


@dataclass(frozen=True, kw_only=True)
class SearchProblem:
    """All inputs of a search."""

    observations: Observations
    search: config.Search
    simulation: config.SimulationSettings
    losses: config.Losses
    quirks: config.ReleasedQuirks
    device: str = "cpu"
    clusters: int = 1
    together: int = 0
    """Maximum number of candidates per launch; 0: 8 on a CPU, a generation on a GPU. On a CPU, costs do not depend on it, bit for
    bit."""
    threads: int = 1
    """Number of threads that simulate at the same time, on a CPU."""
    pool: tuple[Observations, ...] = ()
    """Other recordings of the object; a candidate's cost is the mean over all recordings.

    Springs are built once, on the nodes of `observations` at rest, with the `spacing` and `reach` of these nodes. They are moved
    to each recording, node i on node i. Radii in units of each recording would connect other nodes, so a material would be tested
    with several topologies.
    """
    recordings: tuple[Recording, ...] = field(init=False)
    """The scenario's recording and those of the pool; a candidate has a twin on each."""
    labels: np.ndarray = field(init=False)
    """Region of each node [N]."""
    spacing: float = field(init=False)
    """Distance between neighboring nodes in the rest shape, m (topology.py)."""
    reach: float = field(init=False)
    """Smallest distance between a controller and a node in the rest shape, m."""

    def __post_init__(self) -> None:
        require_pool(self.observations, self.pool)
        canonical, count = self.observations.canonical, len(self.observations.nodes)
        nodes, hands = canonical[:count], canonical[count:]
        object.__setattr__(self, "labels", regions(nodes, self.clusters))
        object.__setattr__(self, "recordings", tuple(map(self._recording, (self.observations, *self.pool))))
        object.__setattr__(self, "spacing", node_spacing(nodes))
        object.__setattr__(self, "reach", controller_reach(nodes, hands))

    def _recording(self, observations: Observations) -> Recording:
        hands = torch.tensor(observations.controller_points, device=self.device)[: observations.scenario.train_end]
        start = initial_velocity(observations, self.simulation.initial_velocity)
        return Recording(
            observations=observations,
            hands=waypoints(hands, observations.controller_valid),
            velocity=torch.tensor(start, dtype=torch.float32, device=self.device),
            loss=FrameLoss.of(observations, self.losses, self.device, frozen_counts=self.quirks.frozen_loss_denominators),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all variables of a candidate; regional variables are name.0, name.1, ..., or plain with a single region."""
        names = []
        for name in VARIABLES:
            regional = name in REGIONAL and self.clusters > 1
            names += [f"{name}.{region}" for region in range(self.clusters)] if regional else [name]
        return tuple(names)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the searched variables: `names` without `search.fixed`."""
        return tuple(name for name in self.names if name.partition(".")[0] not in self.search.fixed)

    def decode(self, normalized: np.ndarray) -> dict[str, float]:
        """Convert normalized `variables` to physical values of all `names`, lengths in m. Neighbor counts are truncated."""
        searched = dict(zip(self.variables, normalized, strict=True))
        values = {}
        for name in self.names:
            base = name.partition(".")[0]
            variable = getattr(self.search.variables, base)
            value = variable.value(float(searched[name])) if name in searched else float(variable.start)
            if base in LENGTHS and self.search.lengths != "meter":
                value = value * self.spacing + (self.reach if base == "controller_radius" else 0.0)
            values[name] = float(int(value)) if base in INTEGERS else value
        return values

    def encode(self) -> np.ndarray:
        """Return the normalized `variables` of the start values."""
        settings = [getattr(self.search.variables, name.partition(".")[0]) for name in self.variables]
        return np.array([variable.normalized(variable.start) for variable in settings])

    def of_regions(self, values: dict[str, float], name: str) -> list[float]:
        """Return the value of a regional variable in each region."""
        return [values[name]] if self.clusters == 1 else [values[f"{name}.{region}"] for region in range(self.clusters)]


def with_substeps(twin: Twin, settings: config.SimulationSettings, frame_time_667: bool) -> Twin:
    """Set the substeps of a twin: 667 with the quirk, otherwise the configured count, or with `auto` the smallest safe count.

    Raises InputError if a fixed count is too small, and NumericalFailure if `auto` requires more than `stability.MAX_SUBSTEPS`.
    """
    if frame_time_667 or settings.substeps != "auto":
        count = stability.RELEASED_SUBSTEPS if frame_time_667 else int(settings.substeps)
        twin = stability.with_substeps(twin, count)
        stability.check(twin)
        return twin
    count = stability.needed_substeps(twin, settings.safety)
    if count > stability.MAX_SUBSTEPS:
        raise NumericalFailure(f"requires {count} substeps per frame, more than {stability.MAX_SUBSTEPS}")
    return stability.with_substeps(twin, count)


def candidate(problem: SearchProblem, values: dict[str, float], push: bool = False) -> Twin:
    """Build the twin of a set of physical values. Its controllers hold, or only `push`.

    Raises InputError or NumericalFailure if the twin cannot be integrated.
    """
    observations, settings, scenario = problem.observations, problem.simulation, problem.observations.scenario
    topology = piecewise_topology(
        observations.nodes,
        observations.controller_points[0],
        problem.labels,
        problem.of_regions(values, "object_radius"),
        [int(n) for n in problem.of_regions(values, "object_neighbors")],
        values["controller_radius"],
        int(values["controller_neighbors"]),
        repair=problem.search.isolated_nodes == "repair",
        rest_shape=observations.rest_shape,
        controller_rest=problem.search.controller_rest,
    )
    count = len(topology.springs)
    if count == 0:
        raise NumericalFailure("no node has a spring")
    if push:
        # A controller that pushes acts from the contact distance on, not from its distance in frame 0.
        led = np.arange(count) >= topology.object_spring_count
        lengths = np.where(led, np.minimum(topology.rest_lengths, values["contact_distance"]), topology.rest_lengths)
        topology = replace(topology, rest_lengths=lengths.astype(np.float32), pushes=led)
    material = homogeneous(values, count)
    simulation = Simulation(
        frame_time=stability.RELEASED_FRAME_TIME if problem.quirks.frame_time_667 else 1.0 / scenario.frame_rate,
        substeps=1,
        up=scenario.up,
        gravity=settings.gravity,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
        collision_capacity=settings.collision_capacity,
        initial_velocity=settings.initial_velocity,
    )
    return with_substeps(Twin(topology=topology, material=material, simulation=simulation), settings, problem.quirks.frame_time_667)


def still_cost(recordings: Sequence[Recording]) -> float:
    """Cost of a static twin, which repeats frame 0, m^2."""
    costs = []
    for recording in recordings:
        nodes = torch.tensor(recording.observations.nodes, dtype=torch.float32, device=recording.hands.device)
        costs.append(np.mean([float(recording.loss(frame, nodes)) for frame in range(1, len(recording.hands))]))
    return float(np.mean(costs))


def groups(twins: Sequence[Twin], device: str, together: int, threads: int) -> list[list[int]]:
    """Group the candidates that are simulated together (`SearchProblem.together`), slowest first.

    On a CPU, lanes wait for the slowest lane, so candidates with similar numbers of substeps form a group. If there are at least
    as many threads as groups, candidates are dealt out in turn, so that all groups end at about the same time.
    """
    order, size = list(range(len(twins))), together or len(twins)
    if device == "cpu":
        order.sort(key=lambda k: -twins[k].simulation.substeps)
        size = min(size, LANE_WIDTH, -(-len(twins) // threads))
    count = -(-len(twins) // size)
    return [order[k::count] if count <= threads else order[k * size : (k + 1) * size] for k in range(count)]


def made(problem: SearchProblem, normalized: np.ndarray, push: bool = False) -> tuple[dict[str, Any], tuple[Twin, ...]]:
    """Build a candidate: its row of the trace, with the penalty as cost, and its twin on each recording.

    There are no twins if one of them cannot be integrated; the row then contains the reason.
    """
    start = time.perf_counter()
    values, settings, released = problem.decode(normalized), problem.simulation, problem.quirks.frame_time_667
    row: dict[str, Any] = {"rollout": 0, "generation": 0, "stage": CMAES, "push": push, "cost": PENALTY, "reason": ""}
    row |= {"springs": 0, "substeps": 0, "collision_overflow": 0, "seconds": 0.0}
    row |= values | {f"normalized.{name}": float(u) for name, u in zip(problem.variables, normalized, strict=True)}
    family: tuple[Twin, ...] = ()
    try:
        twin = candidate(problem, values, push)
        row |= {"springs": len(twin.topology.springs), "substeps": twin.simulation.substeps}
        moved = (move(twin, seen, keep_frame_time=released, rest_lengths=settings.rest_lengths) for seen in problem.pool)
        family = (twin, *(with_substeps(other, settings, released) for other in moved))
    except NumericalFailure as failure:
        row["reason"] = str(failure)
    except stability.Unstable as failure:
        # The candidate is too stiff for a fixed number of substeps.
        row["reason"] = f"{UNSTABLE}: {failure}"
    row["seconds"] = time.perf_counter() - start
    return row, family


def evaluate(
    problem: SearchProblem, population: Sequence[np.ndarray], push: bool, index: int, generation: int, parallel_map: Map = map
) -> Generator[list[Rollouts], list[tuple[list[Outcome], float]], list[dict[str, Any]]]:
    """Evaluate the candidates of a generation; return their rows of the trace, numbered from `index` on.

    `parallel_map` may use several threads. The generator yields the rollouts of each group on each recording. It receives
    their outcomes and times, s.
    """
    candidates = list(parallel_map(lambda normalized: made(problem, normalized, push), population))
    for number, (row, _) in enumerate(candidates):
        row |= {"rollout": index + number, "generation": generation}
    rows, families = [row for row, family in candidates if family], [family for _, family in candidates if family]
    if not families:
        return [row for row, _ in candidates]
    recordings = problem.recordings
    members = groups([family[0] for family in families], problem.device, problem.together, problem.threads)
    answers = iter(
        (
            yield [
                Rollouts([families[k][number] for k in group], recording.hands, recording.velocity, recording.loss)
                for group in members
                for number, recording in enumerate(recordings)
            ]
        )
    )
    for group in members:
        results = [next(answers) for _ in recordings]
        share = sum(seconds for _, seconds in results) / len(group)
        for k, result in zip(group, map(mean_outcome, zip(*(outcomes for outcomes, _ in results), strict=True)), strict=True):
            rows[k]["collision_overflow"] = result.collision_overflow
            rows[k]["seconds"] += share
            if result.diverged_frame:
                rows[k]["reason"] = f"a node left the scene in frame {result.diverged_frame}"
            elif math.isnan(result.cost):
                # CMA-ES would silently rank NaN in the middle.
                rows[k]["reason"] = "the cost is not a number"
            else:
                rows[k]["cost"] = min(result.cost, PENALTY)
    return [row for row, _ in candidates]


def mean_outcome(results: Sequence[Outcome]) -> Outcome:
    """Combine the outcomes of a candidate on several recordings: the mean cost, and divergence if any rollout diverged."""
    if len(results) == 1:
        return results[0]
    diverged = next((outcome.diverged_frame for outcome in results if outcome.diverged_frame), 0)
    cost = float(np.mean([outcome.cost for outcome in results]))
    return Outcome(cost, diverged, sum(outcome.collision_overflow for outcome in results))
