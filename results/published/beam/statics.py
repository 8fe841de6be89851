"""Equilibrium of a lattice under gravity, and its stiffness in pascals.

A load is mass: `Material.mass` of the nodes that carry it.

A motion determines only stiffness over mass, so a modulus requires the density. If the number of nodes along each side doubles,
Y / 4 is needed with true masses, and 2 Y at 1 kg per node. Central forces make the tensor symmetric in all indices (Cauchy): an
isotropic lattice has Poisson's ratio 1/4 and shear modulus E / 2.5; it cannot have those of rubber, 1/2 and E / 3.

Measured on blocks of 10 x 3 x 3 cm, held at one end, springs to 18 neighbors, nodes at the centers of cells (`test_statics.py`):

    nodes across                                        4      6      8
    young along it / (density sum Y l0 / 6 sum m)    1.31   1.20   1.15
    stiffness over young, stretched by its weight    1.04   1.05   1.04
    ... bent by its weight, with 5/6 G A in shear    0.90   0.94   0.96
    ... with I (1 - 1 / n^2), that of n areas        0.95   0.97   0.98

The remaining difference is due to surfaces, which have fewer springs: thin lattices bend more easily than their modulus implies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError, NumericalFailure

STEPS_TO_BALANCE = 500
"""Largest number of steps. A beam that bends by a quarter of its length takes 12."""
UNBALANCED = 1e-6
"""Largest force on a node at rest over the object's weight. Rounding of the energy causes about 1e-8."""


def at_rest(twin: Twin) -> Twin:
    """The twin with its nodes in equilibrium under gravity; rest shape and controllers of frame 0 are unchanged.

    Minimizes sum Y l0 (l / l0 - 1)^2 / 2 - sum m g x by Newton steps in a trust region. All controllers hold. Raises InputError for
    a twin that is not a lattice or that would be below the ground, NumericalFailure if a part is not held.
    """
    from scipy.optimize import minimize

    if twin.body:
        raise InputError("twin.body", "must be a lattice", twin.body.kind)
    topology, simulation, count = twin.topology, twin.simulation, len(twin.topology.nodes)
    hands, lengths = topology.controllers.astype(np.float64), topology.rest_lengths.astype(np.float64)
    weight = np.outer(masses(twin), [0.0, 0.0, -simulation.up_sign * simulation.gravity])
    first, second = topology.springs.T

    def springs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions [S, 3], lengths [S, 1] [m] and stiffness [S, 1] [N] of springs between nodes at x [3 N]."""
        points = np.concatenate([x.reshape(-1, 3), hands])
        along = points[second] - points[first]
        length = np.linalg.norm(along, axis=1)
        return along / length[:, None], length[:, None], twin.material.stiffness.astype(np.float64)[:, None]

    def at_nodes(values: np.ndarray) -> np.ndarray:
        """For each node, the sum of values [S, 3] of springs that end there minus that of springs that begin there [3 N]."""
        ends = [np.bincount(end, column, count + len(hands)) for column in values.T for end in (second, first)]
        return (np.stack(ends[::2], axis=1) - np.stack(ends[1::2], axis=1))[:count].ravel()

    def energy(x: np.ndarray) -> tuple[float, np.ndarray]:
        along, length, stiffness = springs(x)
        strain = length / lengths[:, None] - 1
        total = float((stiffness * lengths[:, None] * strain**2).sum() / 2 - weight.ravel() @ x)
        return total, at_nodes(stiffness * strain * along) - weight.ravel()

    def product(x: np.ndarray, move: np.ndarray) -> np.ndarray:
        along, length, stiffness = springs(x)
        moves = np.concatenate([move.reshape(-1, 3), np.zeros_like(hands)])
        apart = moves[second] - moves[first]
        longer = (apart * along).sum(axis=1, keepdims=True) * along
        return at_nodes(stiffness * (longer / lengths[:, None] + (1 / lengths[:, None] - 1 / length) * (apart - longer)))

    scale, start = np.abs(weight).sum(), topology.nodes.astype(np.float64).ravel()
    options = {"gtol": 1e-3 * UNBALANCED * scale, "maxiter": STEPS_TO_BALANCE}
    found = minimize(energy, start, jac=True, hessp=product, method="trust-krylov", options=options)
    if not np.abs(found.jac).max() <= UNBALANCED * scale:
        raise NumericalFailure(f"the twin is not at rest under gravity after {found.nit} steps; a part may not be held")
    nodes = found.x.reshape(-1, 3)
    if simulation.ground and (lowest := float((simulation.up_sign * nodes[:, 2]).min())) < 0:
        rule = "all nodes must be above the ground, because an equilibrium has no contacts"
        raise InputError("simulation.ground", rule, f"z = {lowest:.3g} m", "Set ground to false.")
    return replace(twin, topology=replace(topology, nodes=nodes.astype(np.float32), rest_shape=topology.canonical))


def masses(twin: Twin) -> np.ndarray:
    """Mass of each node [N], kg; 1 if the material has none."""
    own = twin.material.mass
    return own.astype(np.float64) if len(own) else np.ones(len(twin.topology.nodes))


def elasticity(twin: Twin, density: float) -> np.ndarray:
    """Stiffness tensor of the continuum that a lattice represents [3, 3, 3, 3], Pa, for affine deformations.

    Under the strain e a spring of direction n gets longer by l0 n e n, so C = sum Y l0 n n n n / V over springs between nodes. The
    volume V is the mass of the nodes over `density` [kg/m^3].
    """
    topology, count = twin.topology, twin.topology.object_spring_count
    ends = topology.canonical.astype(np.float64)[topology.springs[:count]]
    along = ends[:, 1] - ends[:, 0]
    n = along / np.linalg.norm(along, axis=1, keepdims=True)
    share = twin.material.stiffness[:count].astype(np.float64) * topology.rest_lengths[:count] * density / masses(twin).sum()
    return np.asarray(np.einsum("s,si,sj,sk,sl->ijkl", share, n, n, n, n, optimize=True))


def young(twin: Twin, density: float) -> np.ndarray:
    """Young's moduli along x, y and z of the continuum that a lattice represents [3], Pa; see `elasticity`.

    For springs in all directions, both Lame parameters are sum Y l0 / (15 V), E is sum Y l0 / (6 V), and Poisson's ratio is 1/4.
    Directions without resistance, such as the normal of a sheet, are left out of the inverse.
    """
    tensor, pairs = elasticity(twin, density), list(zip(*np.triu_indices(3), strict=True))
    # Strains e_ij and e_ji are one unknown, gamma_ij = 2 e_ij.
    compliance = np.linalg.pinv(np.array([[tensor[i + j] for j in pairs] for i in pairs]), rcond=1e-9, hermitian=True)
    return np.asarray([1 / compliance[k, k] for k, (i, j) in enumerate(pairs) if i == j])
