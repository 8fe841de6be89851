"""An exported twin as a model of Newton 1.8. Requires NumPy, Newton, Warp, and the other files of the exported folder.

    model = build("my_twin").finalize()         # particles (nodes, then controllers) and springs
    positions = simulate("my_twin", frames=10)  # [11, N, 3], m

Newton's spring has the force ke (l - l0) + kd dl/dt, so ke = stiffness / rest length and kd = dashpot. Newton's particles have no
drag, so `simulate` slows them after each step. Ground and collisions between nodes are omitted.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import newton
import numpy as np


def load(folder: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and settings of an exported twin."""
    about = json.loads((Path(folder) / "description.json").read_text())
    if (about["format"], about["version"]) != ("neuspring-plain", 1):
        raise ValueError(f"{folder}: the format must be neuspring-plain 1; received {about['format']} {about['version']}.")
    with np.load(Path(folder) / "arrays.npz") as stored:
        arrays = {key: stored[key] for key in stored.files}
    return arrays, {name: entry["value"] for name, entry in about["settings"].items()}


def build(folder: str | Path) -> newton.ModelBuilder:
    """Nodes as particles, controllers as particles that no force moves, and springs."""
    arrays, settings = load(folder)
    down = (0.0, 0.0, -settings["gravity"] * settings["up_sign"])
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=down)
    for position, velocity, mass in zip(arrays["nodes"], arrays["velocity"], arrays["mass"], strict=True):
        builder.add_particle(position.tolist(), velocity.tolist(), float(mass), radius=1e-4)
    for position in arrays["controllers"]:
        builder.add_particle(position.tolist(), (0.0, 0.0, 0.0), 0.0, radius=1e-4, flags=0)
    for (i, j), stiffness, length, dashpot in zip(
        arrays["springs"], arrays["stiffness"], arrays["rest_lengths"], arrays["dashpot"], strict=True
    ):
        builder.add_spring(int(i), int(j), float(stiffness / length), float(dashpot), 0.0)
    builder.spring_rest_length[:] = [float(length) for length in arrays["rest_lengths"]]
    return builder


def simulate(folder: str | Path, frames: int, drag: bool = True, device: str = "cpu") -> np.ndarray:
    """Positions of nodes [frames + 1, N, 3], m, from frame 0 on, by SolverSemiImplicit with the twin's time step.

    The controllers move as exported and keep their last position.
    """
    arrays, settings = load(folder)
    count = len(arrays["nodes"])
    model = build(folder).finalize(device=device)
    model.particle_grid = None  # Otherwise particles repel each other.
    solver: Any = newton.solvers.SolverSemiImplicit(model)
    now: Any = model.state()
    then: Any = model.state()
    control = model.control()
    steps, hands = settings["substeps"], arrays["hands"]
    dt = settings["frame_time"] / steps
    path = np.concatenate([hands, np.repeat(hands[-1:], max(frames + 1 - len(hands), 0), axis=0)]).astype(float)
    result = [arrays["nodes"]]
    for begin, end in itertools.pairwise(path[: frames + 1]):
        for step in range(steps):
            places, speeds = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy()
            places[count:] = begin + (end - begin) * (step + 1) / steps
            speeds[count:] = (end - begin) / settings["frame_time"] * settings["controller_velocity"]
            now.particle_q.assign(places)
            now.particle_qd.assign(speeds)
            now.clear_forces()
            solver.step(now, then, control, None, dt)
            if drag:
                slow = then.particle_qd.numpy()[:count].astype(float) * np.exp(-dt * settings["drag"])
                speeds[:count], places[:count] = slow, places[:count] + dt * slow
                then.particle_q.assign(places)
                then.particle_qd.assign(speeds)
            now, then = then, now
        result.append(now.particle_q.numpy()[:count].copy())
    return np.stack(result)
