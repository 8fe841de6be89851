"""The stability bound of symplectic Euler with dashpots, from the spectrum of a twin.

For unit masses and a mode with stiffness eigenvalue lambda and damping eigenvalue c, the update is stable if

    dt^2 lambda + 2 dt c < 4

(Jury's criterion on z^2 - (2 - c dt - lambda dt^2) z + 1 - c dt). lambda and c are Rayleigh quotients of the same vector. So it
is sufficient that the largest eigenvalue of M(dt) = dt^2 K + 2 dt C is below 4, with K = sum_e (Y / l0) d d^T and C = sum_e gamma
d d^T over the springs' direction blocks. Other masses M replace K and C by M^-1/2 K M^-1/2 and M^-1/2 C M^-1/2. Drag increases
stability and is ignored.

Eigenvalues are those of the rest configuration (Lanczos). Deformation rotates the directions but hardly raises the eigenvalues;
`safety` covers the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError

STABILITY_LIMIT = 4.0
PREDICTION = 0.4
"""Fraction of the bound for predictions. A substep multiplies a damped mode by 1 - dt c; dt c <= 0.8 keeps its sign."""
MAX_SUBSTEPS = 2000
"""Largest number of substeps per frame with `simulation.substeps: auto`. With more, a twin takes seconds per frame."""
RELEASED_SUBSTEPS = 667
RELEASED_FRAME_TIME = RELEASED_SUBSTEPS * 5e-5
"""Duration of a frame with `released_quirks.frame_time_667`, s, whatever the frame rate."""
TOLERANCE = 1e-3
"""Largest relative residual of the eigenvalues."""


class Unstable(InputError):
    """The substep exceeds the stability bound."""


@dataclass(frozen=True)
class Spectrum:
    """Largest eigenvalues of K [1/s^2] and C [1/s], and the node that moves most in the stiffest mode."""

    stiffness: float
    damping: float
    node: int

    def load(self, substep: float) -> float:
        """Return dt^2 lambda + 2 dt c; stable below 4. It is an upper bound, because the maxima may be of different modes."""
        return substep**2 * self.stiffness + 2 * substep * self.damping

    def largest_substep(self, safety: float) -> float:
        """Return the largest dt, s, with load(dt) <= 4 * safety."""
        a, b = self.stiffness, 2 * self.damping
        if a <= 0:
            return np.inf if b <= 0 else STABILITY_LIMIT * safety / b
        return float((-b + np.sqrt(b * b + 4 * a * STABILITY_LIMIT * safety)) / (2 * a))


def rest_spectrum(
    springs: np.ndarray, nodes: np.ndarray, controllers: np.ndarray, stiffness: np.ndarray, damping: np.ndarray, mass: np.ndarray
) -> Spectrum:
    """Compute the largest eigenvalues in the rest configuration.

    - stiffness: Y / l0 [S], N/m
    - damping: gamma [S], N s/m
    - mass: [N], kg; empty: 1 kg each
    """
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
    """The smallest number of substeps per frame with a load below 4 * safety."""
    return int(frame_time / spectrum.largest_substep(safety)) + 1


def needed_substeps(twin: Twin, safety: float) -> int:
    """`smallest_safe_substeps` of a twin at rest."""
    return smallest_safe_substeps(twin_spectrum(twin), twin.simulation.frame_time, safety)


def with_substeps(twin: Twin, count: int) -> Twin:
    """Return the twin with `count` substeps per frame."""
    return replace(twin, simulation=replace(twin.simulation, substeps=count))


def stable(twin: Twin, safety: float) -> Twin:
    """Return the twin with at least the substeps that the fraction `safety` of the stability bound requires."""
    return with_substeps(twin, max(needed_substeps(twin, safety), twin.simulation.substeps))


def for_prediction(twin: Twin) -> Twin:
    """Return the lattice for predictions: with self-collision, it has the substeps that `PREDICTION` requires.

    Above half of the bound, a damped mode changes sign in every substep, and contacts can amplify it. In a folded cloth this
    stretched springs to four times their length. Twins without self-collision do not change. Neither do twins with the released
    frame time, which represent the released simulator.
    """
    simulation = twin.simulation
    if not simulation.self_collision or simulation.frame_time == RELEASED_FRAME_TIME:
        return twin
    return stable(twin, PREDICTION)


def check(twin: Twin) -> None:
    """Raise Unstable, with node, bound and remedy, if the twin's substep exceeds the stability bound."""
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
