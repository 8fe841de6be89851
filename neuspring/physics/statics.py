"""A lattice at rest under gravity, and what its stiffness is in pascals.

A load is mass: `Material.mass` of the nodes that carry it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError, NumericalFailure

STEPS = 200
"""Steps of Newton at most. A beam that bends by a quarter of its length takes 8."""
STILL = 1e-9
"""Largest move of a node in the last step, over the size of the body."""
ROUNDING = 1e-13
"""By this part of weight times size energies of one state may differ."""
SHIFTS = 1e-3, 10.0
"""Where the matrix is not good enough, (mass x shift) is added: the first shift over the spread of K / M, and its growth."""


def at_rest(twin: Twin) -> Twin:
    """The twin in equilibrium under gravity: such are its nodes. Its rest shape stays, and controllers are where frame 0 has them.

    Minimizes sum Y l0 (l / l0 - 1)^2 / 2 - sum m g x by Newton steps (K + shift M) d = force, with a shift where the energy would
    rise. Raises InputError for a rod and for a body that would be below the ground, NumericalFailure where nothing holds a part.
    """
    if twin.rod is not None:
        raise InputError("twin.rod", "equilibria are found of lattices", "a rod", "Use rod_nodes.hanging.")
    topology, simulation = twin.topology, twin.simulation
    mass = masses(twin)
    weight = np.zeros((len(mass), 3))
    weight[:, 2] = -simulation.up_sign * simulation.gravity * mass
    hands = topology.controllers.astype(np.float64)

    def state(x: np.ndarray) -> tuple[float, np.ndarray, Any]:
        return _state(twin, np.concatenate([x, hands]), weight)

    x = topology.nodes.astype(np.float64)
    size = float(np.ptp(np.concatenate([x, hands]), axis=0).max())
    energy, force, matrix = state(x)
    shift, inertia = 0.0, np.repeat(mass, 3)
    least = SHIFTS[0] * float((matrix.diagonal() / inertia).max())
    for _ in range(STEPS):
        move = _solved(matrix, shift * inertia, force)
        after = state(x + move) if np.isfinite(move).all() else None
        if after is None or after[0] > energy + ROUNDING * np.abs(weight).sum() * size:
            shift = max(SHIFTS[1] * shift, least)
            continue
        x, (energy, force, matrix) = x + move, after
        if shift == 0 and np.abs(move).max() < STILL * size:
            break
        shift = shift / SHIFTS[1] if shift > least else 0.0
    else:
        raise NumericalFailure(f"the twin does not come to rest under gravity in {STEPS} steps: is every part of it held?")
    if simulation.ground and (simulation.up_sign * x[:, 2]).min() < 0:
        rule = "contacts are no part of an equilibrium, so all nodes must be above it"
        raise InputError("simulation.ground", rule, f"z = {simulation.up_sign * x[:, 2].min():.3g} m", "Set ground to false.")
    return replace(twin, topology=replace(topology, nodes=x.astype(np.float32), rest_shape=topology.canonical))


def masses(twin: Twin) -> np.ndarray:
    """Mass of each node [N], kg: 1 where the material says nothing."""
    own = twin.material.mass
    return own.astype(np.float64) if len(own) else np.ones(len(twin.topology.nodes))


def elasticity(twin: Twin, density: float) -> np.ndarray:
    """Stiffness tensor of the body that a lattice stands for [3, 3, 3, 3], Pa, if its nodes move as the strain says.

    A spring under the strain e is longer by l0 n e n, n its direction, so C = sum Y l0 n n n n / V over springs between nodes. The
    volume V is mass / density [kg/m^3], and only forces per mass are in a twin: density times the sum over the masses of the nodes.
    """
    topology, count = twin.topology, twin.topology.object_spring_count
    ends = topology.canonical.astype(np.float64)[topology.springs[:count]]
    along = ends[:, 1] - ends[:, 0]
    n = along / np.linalg.norm(along, axis=1, keepdims=True)
    share = twin.material.stiffness[:count].astype(np.float64) * topology.rest_lengths[:count] * density / masses(twin).sum()
    return np.asarray(np.einsum("s,si,sj,sk,sl->ijkl", share, n, n, n, n, optimize=True))


def young(twin: Twin, density: float) -> np.ndarray:
    """Young's moduli along x, y and z of the body that a lattice stands for [3], Pa: see `elasticity`.

    Where springs lie in all directions alike, both of Lame's numbers are sum Y l0 / (15 V), E is sum Y l0 / (6 V), and Poisson's
    ratio 1/4. Without resistance in some direction, as of a sheet across itself, its modulus is that of the rest.
    """
    tensor, pairs = elasticity(twin, density), list(zip(*np.triu_indices(3), strict=True))
    # Strains e_ij and e_ji are one unknown, gamma_ij = 2 e_ij.
    compliance = np.linalg.pinv(np.array([[tensor[i + j] for j in pairs] for i in pairs]), rcond=1e-9, hermitian=True)
    return np.asarray([1 / compliance[k, k] for k, (i, j) in enumerate(pairs) if i == j])


def _state(twin: Twin, points: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray, Any]:
    """Energy, J, forces [3 N], N, and the stiffness matrix [3 N, 3 N], N/m, of nodes, then controllers, at points [N + C, 3], m."""
    from scipy.sparse import coo_matrix

    topology, nodes = twin.topology, len(weight)
    pairs, lengths = topology.springs, topology.rest_lengths.astype(np.float64)
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(along, axis=1)
    n = along / length[:, None]
    stiffness = twin.material.stiffness.astype(np.float64)
    if topology.pushes.size:
        stiffness = np.where(topology.pushes & (length > lengths), 0.0, stiffness)
    tension = stiffness * (length / lengths - 1)
    outer = n[:, :, None] * n[:, None, :]
    across = (tension / length)[:, None, None] * (np.eye(3) - outer)
    block = (stiffness / lengths)[:, None, None] * outer + across
    force = np.zeros_like(points)
    np.add.at(force, pairs[:, 0], tension[:, None] * n)
    np.add.at(force, pairs[:, 1], -tension[:, None] * n)
    first, second = pairs.T
    rows, columns = np.concatenate([first, second, first, second]), np.concatenate([first, second, second, first])
    values = np.concatenate([block, block, -block, -block])
    own = (rows < nodes) & (columns < nodes)
    axes = np.arange(3)
    row = np.broadcast_to(3 * rows[own, None, None] + axes[:, None], values[own].shape)
    column = np.broadcast_to(3 * columns[own, None, None] + axes, values[own].shape)
    matrix = coo_matrix((values[own].ravel(), (row.ravel(), column.ravel())), shape=(3 * nodes, 3 * nodes)).tocsc()
    energy = float((tension**2 * lengths / np.maximum(stiffness, 1e-300)).sum() / 2 - (weight * points[:nodes]).sum())
    return energy, (force[:nodes] + weight).ravel(), matrix


def _solved(matrix: Any, shift: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The move of each node [N, 3], m; NaN where the matrix is singular."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    try:
        move = splu(matrix + diags(shift, format="csc")).solve(force)
    except RuntimeError:
        move = np.full_like(force, np.nan)
    return np.asarray(move.reshape(-1, 3))
