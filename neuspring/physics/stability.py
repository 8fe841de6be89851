"""Is the substep small enough? A bound for symplectic Euler with dashpots, per node and as a spectrum.

For unit masses and a mode with stiffness eigenvalue lambda and damping eigenvalue c, the update is stable if
dt^2 lambda + 2 dt c < 4 (Jury's criterion on z^2 - (2 - c dt - lambda dt^2) z + 1 - c dt). Since lambda and c are Rayleigh
quotients of the same vector, it suffices that the largest eigenvalue of M(dt) = dt^2 K + 2 dt C is below 4, with
K = sum_e (Y / l0) d d^T and C = sum_e gamma d d^T over the springs' direction blocks. Drag only helps and is ignored.
With other masses M, M^-1/2 K M^-1/2 and M^-1/2 C M^-1/2 stand for K and C: a spring's row over the root of each end's mass.

Eigenvalues are those of the rest configuration (Lanczos). Deformation turns directions but hardly raises them: `safety` covers it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError

STABILITY_LIMIT = 4.0
PREDICTION = 0.4
"""Fraction of the bound for predictions. A substep multiplies a damped mode by 1 - dt c; with dt c <= 0.8 it keeps its sign."""
MAX_SUBSTEPS = 2000
"""Upper limit of `simulation.substeps: auto`, per frame: beyond it a twin takes seconds per frame."""
RELEASED_SUBSTEPS = 667
RELEASED_FRAME_TIME = RELEASED_SUBSTEPS * 5e-5
"""s, whatever the frame rate (released_quirks.frame_time_667)."""
TOLERANCE = 1e-3
"""Relative residual of the eigenvalues of a spectrum."""


class Unstable(InputError):
    """The substep is beyond the stability bound."""


@dataclass(frozen=True)
class Spectrum:
    """Largest eigenvalues of K [1/s^2] and C [1/s], and the node that moves most in the stiffest mode."""

    stiffness: float
    damping: float
    node: int

    def load(self, substep: float) -> float:
        """dt^2 lambda + 2 dt c: stable below 4. An upper bound, since both maxima need not share a mode."""
        return substep**2 * self.stiffness + 2 * substep * self.damping

    def largest_substep(self, safety: float) -> float:
        """The largest dt [s] with load(dt) <= 4 * safety."""
        a, b = self.stiffness, 2 * self.damping
        if a <= 0:
            return np.inf if b <= 0 else STABILITY_LIMIT * safety / b
        return float((-b + np.sqrt(b * b + 4 * a * STABILITY_LIMIT * safety)) / (2 * a))


def rest_spectrum(
    springs: np.ndarray, nodes: np.ndarray, controllers: np.ndarray, stiffness: np.ndarray, damping: np.ndarray, mass: np.ndarray
) -> Spectrum:
    """Largest eigenvalues in the rest configuration. stiffness is Y / l0 [S], damping gamma [S], mass [N], kg, or empty: 1 each."""
    from neuspring.physics import lanczos

    ends = np.concatenate([nodes, controllers]).astype(np.float64)[springs.reshape(-1, 2)]
    offset = ends[:, 1] - ends[:, 0]
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
    scale = np.append(1 / np.sqrt(mass.astype(np.float64)) if len(mass) else np.ones(len(nodes)), np.zeros(len(controllers)))
    (k, node), (c, _) = lanczos.largest(springs, direction, scale, (stiffness, damping), TOLERANCE)
    return Spectrum(k, c, node)


def twin_spectrum(twin: Twin) -> Spectrum:
    """The spectrum of a twin at rest."""
    topology, material = twin.topology, twin.material
    stiffness, damping = material.stiffness.astype(np.float64) / topology.rest_lengths, material.dashpot.astype(np.float64)
    return rest_spectrum(topology.springs, topology.nodes, topology.controllers, stiffness, damping, material.mass)


def smallest_safe_substeps(spectrum: Spectrum, frame_time: float, safety: float) -> int:
    """The smallest number of substeps per frame whose load is below 4 * safety."""
    return int(frame_time / spectrum.largest_substep(safety)) + 1


def needed_substeps(twin: Twin, safety: float) -> int:
    """The same for a twin at rest."""
    return smallest_safe_substeps(twin_spectrum(twin), twin.simulation.frame_time, safety)


def with_substeps(twin: Twin, count: int) -> Twin:
    """The twin with so many substeps per frame."""
    return replace(twin, simulation=replace(twin.simulation, substeps=count))


def stable(twin: Twin, safety: float) -> Twin:
    """The twin with at least as many substeps as a part `safety` of the stability bound asks for."""
    return with_substeps(twin, max(needed_substeps(twin, safety), twin.simulation.substeps))


def for_prediction(twin: Twin) -> Twin:
    """A lattice as predictions are made with it: where the body can meet itself, with substeps for `PREDICTION`.

    Above half of the bound a damped mode turns around in every substep, and a contact that meets it on its way back kicks it again:
    springs of a cloth that lay on itself were stretched to four times their length. Other twins stay as they are, and so does one
    with the released frame time, which stands for the released simulator.
    """
    simulation = twin.simulation
    if not simulation.self_collision or simulation.frame_time == RELEASED_FRAME_TIME:
        return twin
    return stable(twin, PREDICTION)


def check(twin: Twin) -> None:
    """Raise Unstable, naming node, bound and remedy, if the twin's substep is beyond the stability limit."""
    simulation, spectrum = twin.simulation, twin_spectrum(twin)
    if spectrum.load(simulation.substep) >= STABILITY_LIMIT:
        largest = spectrum.largest_substep(1.0)
        needed = smallest_safe_substeps(spectrum, simulation.frame_time, 1.0)
        raise Unstable(
            f"simulation.substeps, node {spectrum.node}",
            f"the substep must stay below {largest:.3g} s, the stability bound of this node (the stiffest, most damped)",
            f"{simulation.substep:.3g} s ({simulation.substeps} substeps per frame)",
            f"Use at least {needed} substeps, or substeps: auto.",
        )
