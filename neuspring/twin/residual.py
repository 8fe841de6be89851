"""A correction of predicted center lines that is learned on residuals: ridge regression on local features of the rollout.

It is no physics, so it is a row of its own. At every time z is up, x the horizontal direction from the first vertex to the last,
y = z x x. In this frame, R_t in its columns, a free vertex has the features

    f = (height, velocity, acceleration, curvature, vectors to the held vertices, time, arc, 1)
        (x) (sin pi s, sin 2 pi s, sin 3 pi s) (1 - exp(-t / tau)),

s from 0 to 1 along the line between the clamps. The correction R_t W' f turns with motions about the vertical, moves with
horizontal ones, and vanishes at the clamps and in frame 0, which is given. W has the least

    sum over clips |W' f - R_t' (target - rollout)|^2 / |target - rollout|^2 + ridge |W|^2,

where features have unit mean square. The ridge weight is the best on clips that are left out in turn; where none is better there
than no correction, W is 0. Derivatives over time are central differences: a frame's correction uses the next two frames of the
rollout, and never the target's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neuspring.core.artifacts import Residual, Twin
from neuspring.core.errors import InputError

WAVES = 3
"""Sines along the line that each feature is multiplied by."""
ONSET = 0.1
"""tau, s: errors of rollouts grow for so long."""
RIDGES = tuple(10.0 ** np.arange(-6.0, 2.0))
"""Ridge weights that are tried."""
LEAST = 1e-6
"""Ends whose horizontal distance is smaller, m, lie above each other: the frame keeps its last direction."""


def features(positions: np.ndarray, dt: float, free: np.ndarray) -> np.ndarray:
    """Features [T, V', F] of the free vertices of a center line [T, V, 3], m, at times dt, s, apart; `free` [V] says which are.

    Raises InputError unless both ends are held.
    """
    inner = np.flatnonzero(free)
    if not (len(inner) and inner[0] > 0 and inner[-1] < len(free) - 1):
        raise InputError("residual", "both ends of the line must be held, and a vertex between them free", free.tolist())
    edges = np.diff(positions, axis=1)
    lengths = np.linalg.norm(edges, axis=2, keepdims=True)
    arc = np.concatenate([[0.0], np.cumsum(lengths.mean(axis=(0, 2)))])
    along = (arc[inner] - arc[inner[0] - 1]) / (arc[inner[-1] + 1] - arc[inner[0] - 1])
    velocity = np.gradient(positions, dt, axis=0)
    curvature = 2 * np.diff(edges / lengths, axis=1) / (lengths[:, 1:] + lengths[:, :-1])
    vectors = [velocity[:, inner], np.gradient(velocity, dt, axis=0)[:, inner], curvature[:, inner - 1]]
    vectors += [positions[:, [held]] - positions[:, inner] for held in np.flatnonzero(~free)]
    turned = [vector @ _axes(positions) for vector in vectors]
    time = dt * np.arange(len(positions))[:, None, None] + 0 * along[:, None]
    local = np.concatenate([positions[:, inner, 2:], *turned, time, along[:, None] + 0 * time, 1 + 0 * time], axis=2)
    waves = np.sin(np.pi * np.arange(1, WAVES + 1) * along[:, None])
    onset = 1 - np.exp(-time / ONSET)
    return np.asarray(((local * onset)[..., None] * waves[:, None]).reshape(*local.shape[:2], -1))


def _axes(positions: np.ndarray) -> np.ndarray:
    """The frame at every time [T, 3, 3], x, y and z in its columns, of a center line [T, V, 3]."""
    across = (positions[:, -1] - positions[:, 0])[:, :2]
    length = np.linalg.norm(across, axis=1)
    kept = np.maximum.accumulate(np.where(length > LEAST, np.arange(len(across)), 0))
    x, y = (across[kept] / np.maximum(length[kept], LEAST)[:, None]).T
    return np.moveaxis(np.array([[x, -y, 0 * x], [y, x, 0 * x], [0 * x, 0 * x, 1 + 0 * x]]), -1, 0)


def fit(
    rollouts: Sequence[np.ndarray], targets: Sequence[np.ndarray], groups: Sequence[str], dt: float, free: np.ndarray
) -> Residual:
    """Learn from rollouts of one line and their targets [T, V, 3], m. Rollouts of a group (a clip) are left out together.

    Raises InputError for fewer than two groups.
    """
    if len(set(groups)) < 2:
        raise InputError("residual", "at least two training clips are required, so that one can be left out", sorted(set(groups)))
    parts = []
    for rollout, target in zip(rollouts, targets, strict=True):
        f, wanted = features(rollout, dt, free), ((target - rollout)[:, free] @ _axes(rollout)).reshape(-1, 3)
        f, size = f.reshape(len(wanted), -1), (wanted**2).sum() + LEAST**2 * wanted.size
        parts.append((f.T @ f / size, f.T @ wanted / size))
    grams, products = (np.array(part) for part in zip(*parts, strict=True))
    scale = np.sqrt(np.maximum(np.einsum("gff->f", grams), np.finfo(float).tiny))
    grams, products = grams / (scale[:, None] * scale), products / scale[:, None]
    names = np.array(groups)

    def solved(kept: np.ndarray, ridge: float) -> np.ndarray:
        gram = grams[kept].sum(axis=0) + kept.mean() * ridge * np.eye(len(scale))
        return np.asarray(np.linalg.solve(gram, products[kept].sum(axis=0)))

    def left_out(ridge: float) -> float:
        total = 0.0
        for name in dict.fromkeys(groups):
            out, w = names == name, solved(names != name, ridge)
            total += out.sum() - 2 * (w * products[out].sum(axis=0)).sum() + (w * (grams[out].sum(axis=0) @ w)).sum()
        return total / len(names)

    errors = {ridge: left_out(ridge) for ridge in RIDGES}
    best = min(errors, key=errors.__getitem__)
    weights = solved(names == names, best) / scale[:, None] * (errors[best] < 1)
    return Residual(weights=weights, ridge=best, left_out=errors[best])


def apply(residual: Residual, positions: np.ndarray, dt: float, free: np.ndarray) -> np.ndarray:
    """A predicted center line [T, V, 3], m, with the correction added; held vertices stay."""
    corrected = np.array(positions, dtype=np.float64)
    change = features(corrected, dt, free) @ residual.weights
    corrected[:, free] += change @ np.moveaxis(_axes(corrected), 1, 2)
    return corrected


def corrected(twin: Twin, positions: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """Nodes [T, N, 3], m, of a rollout of a rod with its correction added; hands [T, C, 3], m. Nodes go with the line."""
    rod, residual = twin.rod, twin.residual
    assert rod is not None
    assert residual is not None
    line = np.concatenate([positions, hands], axis=1)[:, rod.line].astype(np.float64)
    change = apply(residual, line, twin.simulation.frame_time, rod.held < 0) - line
    part = rod.place[:, :1]
    moved: np.ndarray = positions + (1 - part) * change[:, rod.edge] + part * change[:, rod.edge + 1]
    return moved
