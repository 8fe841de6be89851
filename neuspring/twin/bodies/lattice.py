"""The lattice: nodes joined by springs with dashpots, as in PhysTwin and the paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from neuspring.config import Config
from neuspring.config.simulation import RestLengths
from neuspring.core.artifacts import Observations, Twin
from neuspring.physics import stability
from neuspring.twin.body import Body, FitTask, Learned, Lines, SearchOptions, SearchTask

if TYPE_CHECKING:
    from neuspring.physics.solver import FrameSolver
    from neuspring.twin.candidates import SearchProblem
    from neuspring.twin.fit import FitProblem, FitResult
    from neuspring.twin.search import SearchResult


class Lattice(Body):
    """A spring-mass model, stored in the topology and the material of a twin."""

    name = "lattice"
    fits = ("springs", "field")
    by_gradients = True
    format = "neuspring-plain"
    about = "A spring-mass twin: nodes joined by springs with dashpots"
    equations = """
A frame has `substeps` steps of dt = frame_time / substeps. Step k = 0, 1, ... of a frame computes, in this order:

1. Controllers are at begin + (end - begin) u, u = (k + 1) / substeps, with begin and end the rows of `hands` of this frame and of
the next. Nodes are at the end of the previous step.

2. Spring (i, j): d = (x_j - x_i) / l, l = |x_j - x_i|; force on i: (stiffness (l / rest_length - 1) + dashpot (v_j - v_i) . d) d,
its negative on j. An index of N or more is controller index - N. The velocity of a controller is 0 or, if controller_velocity is
true, that of its path. A spring with `pushes` has no force while l > rest_length.

3. Springs of a controller have no force in this frame if its `holds` is false in this frame or in the next.

4. w = v + dt (force / mass + (0, 0, -gravity up_sign)).

5. Drag: v' = w exp(-dt drag).

6. If self_collision: pairs of nodes change their velocity if they were closer than contact_distance at the begin of the frame,
are closer now, and approach (dx . dv < 0). With n = dx / |dx|, u = v_j - v_i = u_n + u_t, u_n along n, a = max(0, 1 -
contact_friction (1 + contact_elasticity) |u_n| / |u_t|), node i loses the mean over its partners of mass_j / (mass_i + mass_j)
(-(1 + contact_elasticity) u_n + (a - 1) u_t).

7. x' = x + dt v'. If ground, a node that moves down and would be below z = 0 (z up_sign < 0) moves to z = 0. Its velocity becomes
(a v_x, a v_y, -ground_elasticity v_z), a = max(0, 1 - ground_friction (1 + ground_elasticity) |v_z| / |v_xy|), and it moves on
for the rest of dt.
"""

    def describes(self, twin: Twin) -> bool:
        return twin.body is None

    def search(
        self, observations: Observations, pool: Sequence[Observations], settings: Config, options: SearchOptions
    ) -> SearchResult:
        """Run CMA-ES over topology and a homogeneous material; see `search.search`."""
        from neuspring.twin.search import search

        return search(_problem(observations, pool, settings, options), options.seed, record=options.record, key=options.key)

    def search_many(self, tasks: Sequence[SearchTask]) -> Sequence[Learned | Exception]:
        from neuspring.twin.search import SearchRun, search_many

        problems = [_problem(task.observations, task.pool, task.settings, task.options) for task in tasks]
        runs = [
            SearchRun(problem, task.options.seed, task.options.record, task.options.key)
            for problem, task in zip(problems, tasks, strict=True)
        ]
        return [*search_many(runs)]

    def fit(self, problem: FitProblem, *, partial: Path | None = None, key: str = "", threads: int = 1) -> FitResult:
        """Run Adam with gradients through the simulation, on one thread; see `fit.fit`."""
        from neuspring.twin.fit import fit

        return fit(problem, partial=partial, key=key)

    def fit_many(self, tasks: Sequence[FitTask], most: int = 0) -> Sequence[Learned | Exception]:
        from neuspring.twin.fit import fit_many

        return [*fit_many(tasks, most)]

    def require_pool(self, here: Observations, pool: Sequence[Observations]) -> None:
        """Require as many nodes and controllers in all recordings, in the same order; see `transfer.require_pool`."""
        from neuspring.twin.transfer import require_pool

        require_pool(here, pool)

    def on_recording(self, twin: Twin, observations: Observations, rest_lengths: RestLengths) -> Twin:
        """Keep the springs on the same nodes; see `transfer.on_nodes`."""
        from neuspring.twin.transfer import on_nodes

        return on_nodes(twin, observations, rest_lengths)

    def solver(self, twin: Twin, device: str = "cpu") -> FrameSolver:
        from neuspring.physics.solver import solver_for

        return solver_for(twin, device, differentiable=False)

    check = staticmethod(stability.check)
    stable = staticmethod(stability.stable)
    for_prediction = staticmethod(stability.for_prediction)

    def load(self, twin: Twin) -> float:
        return stability.twin_spectrum(twin).load(twin.simulation.substep)

    def lines(self, twin: Twin) -> Lines:
        """Return all springs, object springs first."""
        topology, mass = twin.topology, twin.material.mass
        nodes, hands = len(topology.nodes), len(topology.controllers)
        masses = mass if len(mass) else np.ones(nodes, np.float32)
        return Lines(
            pairs=topology.springs,
            rest_lengths=topology.rest_lengths,
            stiffness=twin.material.stiffness,
            inner=topology.object_spring_count,
            kind="springs",
            about="object springs",
            labels=np.pad(topology.labels, (0, hands), constant_values=topology.labels.min()),
            masses=np.concatenate([masses, np.zeros(hands, np.float32)]),
            points=lambda x, held: np.concatenate([x, held]),
        )

    def node_stiffness(self, twin: Twin) -> np.ndarray:
        """Return the geometric mean stiffness of each node's object springs [N], N; without springs, the median of all."""
        count = twin.topology.object_spring_count
        pairs, values = twin.topology.springs[:count], np.maximum(twin.material.stiffness[:count].astype(float), 1e-30)
        nodes = len(twin.topology.nodes)
        degree = np.bincount(pairs.ravel(), minlength=nodes)
        total = np.bincount(pairs.ravel(), np.repeat(np.log(values), 2), minlength=nodes)
        typical = float(np.median(np.log(values))) if count else 0.0
        return np.exp(np.where(degree > 0, total / np.maximum(degree, 1), typical))

    def mass_at(self, twin: Twin, node: int) -> float:
        return float(twin.material.mass[node]) if len(twin.material.mass) else 1.0


def _problem(observations: Observations, pool: Sequence[Observations], settings: Config, options: SearchOptions) -> SearchProblem:
    from neuspring.twin.candidates import SearchProblem

    return SearchProblem(
        observations=observations,
        pool=tuple(pool),
        search=settings.search,
        simulation=settings.simulation,
        losses=settings.losses,
        quirks=settings.released_quirks,
        clusters=options.clusters,
        device=options.device,
        threads=options.threads,
        together=options.together,
    )


body = Lattice()
