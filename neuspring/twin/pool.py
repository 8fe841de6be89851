"""First-order stage on several recordings of one object: one material; for each recording its own hands, start and frames.

An epoch is one pass over each recording in turn, with the same parameters and the same state of Adam. Stiffness, dashpots, drag and
contact are shared, and so are trained rest lengths, as factors on the distances in each recording's rest shape: those of springs,
and those that the estimated shape makes (rest_shape.py), whose displacement lives in the rest shape of the problem's own recording.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.physics.parameters import Parameters
from neuspring.twin.batch import Lane
from neuspring.twin.fit import FitProblem, TwinFit
from neuspring.twin.transfer import on_recording, require_pool


class PooledFit(TwinFit):
    """Epochs over a pool. Parameters and twin are those on the nodes of the problem; with no pool, the fit is that of `TwinFit`.

    All recordings take as many substeps per frame as the one that needs most. Losses are means over the recordings, in one unit.
    An oracle's are over all frames of the recordings that count.
    """

    def __init__(
        self, problem: FitProblem, lane: Lane | None = None, *, pool: Sequence[Observations] = (), leave_out: bool = False
    ) -> None:
        """`leave_out`: only frame 0 of the problem's observations is used; the pool alone is fitted. Raises InputError."""
        require_pool(problem.observations, pool, leave_out)
        if lane is not None:
            raise InputError("twins_per_launch", "fits on several recordings share no launches", "a lane", "Fit each alone.")
        super().__init__(problem)
        moved = [(on_recording(problem.twin, observations, problem.quirks), observations) for observations in pool]
        self._leave_out = leave_out
        self._members = [] if leave_out else [self._member(problem)]
        self._members += [self._member(replace(problem, twin=twin, observations=seen)) for twin, seen in moved]

    def _member(self, problem: FitProblem) -> TwinFit:
        """The fit of one recording, which trains this one's parameters with this one's optimizer."""
        member = TwinFit(problem)
        start = self.parameters.start | {"rest_lengths": member.parameters.start["rest_lengths"]}
        # The copy has the same trained tensors.
        member.parameters = copy.copy(self.parameters)
        member.parameters.start = start
        member.optimizer = self.optimizer
        # Frame 0 of each recording has a spacing of its own; a meter must weigh the same in all.
        member.loss_scale = self.loss_scale
        return member

    @property
    def one_step(self) -> bool:
        """Whether an epoch is a single optimizer step: never of several recordings."""
        return len(self._members) == 1 and self._members[0].one_step

    @property
    def collision_overflow(self) -> int:
        """The sum over all recordings."""
        return sum(member.collision_overflow for member in self._members)

    def use_substeps(self, count: int) -> None:
        """Integrate all recordings with `count` substeps per frame from now on."""
        super().use_substeps(count)
        for member in self._members:
            member.use_substeps(count)

    def stable_parameters(self) -> Parameters:
        """The present parameters, packed, after seeing that they can be integrated on every recording. Raises NonFinite."""
        for member in self._members:
            member.stable_parameters()
        if self._leave_out:
            super().stable_parameters()
        self.use_substeps(max(run.twin.simulation.substeps for run in [self, *self._members]))
        return self.parameters.pack(self.twin.simulation.substep)

    def epoch(self) -> dict[str, float]:
        """One pass over each recording; raises NonFinite. Means over the recordings, and the largest gradient of any step."""
        for member in self._members:
            member.gradients = self.gradients
        rows = [member.epoch() for member in self._members]
        if len(rows) == 1:
            return rows[0]
        return {"loss": sum(row["loss"] for row in rows) / len(rows), "gradient_norm": max(row["gradient_norm"] for row in rows)}

    def tail_loss(self) -> float:
        """Mean loss of the held-back frames of all recordings, m^2. Raises NonFinite."""
        return sum(member.tail_loss() for member in self._members) / len(self._members)
