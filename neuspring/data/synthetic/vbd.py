"""A second engine, for a held-out split with other numerics: vertex block descent (Chen et al. 2024), implicit Euler solved node by
node. Solids that hands grip; no fists, no sheets.

Its damping is that of implicit Euler, not a material's; its friction is the engine's smoothed Coulomb friction. It is converged at
SUBSTEPS x ITERATIONS and far from it at what games use, so neither is a setting.
"""

from __future__ import annotations

import newton
import numpy as np
import warp as wp

from neuspring.data.synthetic import fem_kernels as kernels
from neuspring.data.synthetic.fem import FiniteElements
from neuspring.data.synthetic.fem_model import build, lame

SUBSTEPS, ITERATIONS = 40, 10


class VertexBlockDescent(FiniteElements):
    """`FiniteElements` with another integrator and the plain Lame parameters that its energy takes."""

    def _build(self, fists: int) -> newton.Model:
        assert not fists, "the held-out engine has no fists"
        assert not self.body.is_sheet, "the held-out engine has no sheets"
        model = build(self.body, 0, lame, dashpots=False, colored=True)
        model.soft_contact_mu = self.body.friction
        return model

    def _solver(self) -> newton.solvers.SolverBase:
        return newton.solvers.SolverVBD(self.model, iterations=ITERATIONS, particle_enable_tile_solve=False)

    def _choose_substeps(self, substeps: int | None) -> int:
        return substeps or SUBSTEPS

    def _hold(self, fists: list[int], earlier: np.ndarray | None) -> None:
        super()._hold(fists, earlier)
        # Without mass a node would still give way to its neighbors.
        flags = np.where(self.holder < 0, int(newton.ParticleFlags.ACTIVE), 0)
        self.model.particle_flags.assign(flags.astype(np.int32))

    def _substeps(self) -> None:
        for _ in range(self.substeps):
            now, following = self.now, self.next
            now.clear_forces()
            # Held nodes do not move within a step: they are put where they are at its end.
            wp.launch(kernels.advance, 1, [self._step], device="cpu")
            held = [self._step, self._poses, self._holder, self._local, self.substep, now.particle_q, now.particle_qd]
            wp.launch(kernels.drive_nodes, self.model.particle_count, held, device="cpu")
            self.pipeline.collide(now, self.contacts)
            self.solver.step(now, following, self.control, self.contacts, self.substep)
            self.now, self.next = following, now
