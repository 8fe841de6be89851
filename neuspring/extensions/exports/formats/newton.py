"""Newton: a script that makes its model of a twin, beside the plain export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from operator import mul
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Rod
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.extensions.exports import Export, cable
from neuspring.extensions.exports.formats import npz, ply
from neuspring.extensions.exports.source import ExportSource, require_start
from neuspring.twin.body import body_of

SCRIPT = Path(__file__).parents[1] / "newton_twin.py"
CHAIN_FILE = "chain.npz"
SHEAR = 0.01
"""Share of the sag between two clamps that shear may add: Newton's joints give way sideways, ours do not."""
STRAIN = 1e-3
"""Stretch of a rod by its own weight, if its EA allows no more."""
SHORTEST_STEP = 1e-4
"""s: Newton keeps poses of bodies in float32, which stand still in shorter steps."""


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz, description.json, newton_twin.py and, of a rod, chain.npz to the folder `output`."""
    require_start(frames)
    springs = source.twin.topology
    if springs.pushes.any():
        rule = "Newton's springs pull as well as push"
        raise InputError("--to newton", rule, f"{source.name}, whose hands only push", "Take --to mujoco or npz.")
    made = [output / SCRIPT.name]
    if rod := body_of(source.twin).center_line(source.twin):
        if len(springs.springs):
            rule = "Newton has no springs between particles and bodies"
            raise InputError("--to newton", rule, f"{source.name}, a rod that hands pull by springs", "Take --to mujoco.")
        made.append(output / CHAIN_FILE)
        npz.save_arrays(made[-1], chain_arrays(source, rod, frames))
    write_text(output / SCRIPT.name, SCRIPT.read_text(encoding="utf-8"))
    return [*npz.write(source, frames, output), *made]


def chain_arrays(source: ExportSource, rod: Rod, frames: Sequence[int]) -> dict[str, np.ndarray]:
    """Arrays of `newton.Rod` and of its joints, bodies and clamps; quaternions have w last, and z along the edge.

    Raises InputError if the solver needs a step that is too short for it: a joint may turn an edge, and pull at it, by no more than
    its inertia over a step resists, or the iterations end before the rod is as stiff as it should be.
    """
    chain = cable.chain_of(rod)
    rest = Rotation.concatenate(list(accumulate(chain.rest, mul, initial=chain.frames[0])))
    along = rod.lengths[:, None] * rest.as_matrix()[..., 0]
    held = list(chain.held.values())
    spans, weight = rod.spans[1:-1], source.twin.simulation.gravity * rod.mass.sum()
    # A beam of n edges, each of which gives way by force / pull, sags by this share more: 96 EI / (pull l^3 n^2). Below 4 EI / l^3
    # turning would need the shorter steps.
    stiff = max(4.0, 96 / (SHEAR * (len(rod.lengths) - len(held)) ** 2))
    pull = np.maximum(stiff * chain.bend / spans**2, min(rod.stretching, weight / STRAIN) / spans)
    step = min(source.twin.simulation.substep, float(np.sqrt(np.minimum(chain.mass[:-1], chain.mass[1:]) / pull).min()))
    if step < SHORTEST_STEP:
        rule = f"Newton's solver of rods needs steps of {SHORTEST_STEP:g} s or more, or its float32 poses stand still"
        found = f"{source.name}, which is so stiff, or has so short edges, that it needs {step:.2g} s"
        raise InputError("--to newton", rule, found, "Take --to mujoco, or fit fewer vertices.")
    clamps = np.zeros((len(frames), len(held), 7))
    for row, frame in enumerate(frames):
        line = ply.points(source, frame)[-len(rod.vertices) :]
        clamps[row, :, :3] = ((line[:-1] + line[1:]) / 2)[held]
        clamps[row, :, 3:] = _quaternions(cable.frames_of(replace(rod, vertices=line)))[held]
        # q and -q are one pose, but not between two poses.
        clamps[row, :, 3:] *= np.where((clamps[row] * clamps[row - 1])[:, 3:].sum(axis=1, keepdims=True) < 0, -1, 1)
    return {
        "points": rod.vertices,
        "quaternions": _quaternions(chain.frames),
        "rest_points": rod.vertices[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)]),
        "rest_quaternions": _quaternions(rest),
        "stiffness": np.stack([pull, pull, pull, chain.bend, chain.bend, chain.twist], axis=1),
        "mass": chain.mass,
        "step": np.array(step),
        "held": np.array(held, np.int32),
        "clamps": clamps,
    }


def _quaternions(frames: Rotation) -> np.ndarray:
    """Quaternions of axes m1, m2, t, w last [E, 4]."""
    return np.asarray(Rotation.from_matrix(np.roll(frames.as_matrix(), -1, axis=-1)).as_quat())


export = Export(write=write, name="{name}_newton")
