"""An exported twin as a model of Newton 1.8. This file is complete: it needs NumPy, Newton and Warp, and the files beside it.

    model = build("my_twin").finalize()         # particles (nodes, then controllers) and springs
    positions = simulate("my_twin", frames=10)  # [11, N, 3], m

Newton's spring has the force ke (l - l0) + kd dl/dt, so ke = stiffness / rest length and kd = dashpot. Its particles have no drag:
`simulate` slows them after each step. Ground and collisions between nodes are left out.
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
    said = json.loads((Path(folder) / "description.json").read_text())
    if (said["format"], said["version"]) != ("neuspring-plain", 1):
        raise ValueError(f"{folder}: format neuspring-plain 1 is required, received {said['format']} {said['version']}")
    with np.load(Path(folder) / "arrays.npz") as stored:
        arrays = {key: stored[key] for key in stored.files}
    return arrays, {name: entry["value"] for name, entry in said["settings"].items()}


def build(folder: str | Path) -> newton.ModelBuilder:
    """Nodes as particles, controllers as particles that do not move by themselves, and springs."""
    arrays, settings = load(folder)
    down = (0.0, 0.0, -settings["gravity"] * settings["up_sign"])
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=down)
    for place, velocity, mass in zip(arrays["nodes"], arrays["velocity"], arrays["mass"], strict=True):
        builder.add_particle(place.tolist(), velocity.tolist(), float(mass), radius=1e-4)
    for place in arrays["controllers"]:
        builder.add_particle(place.tolist(), (0.0, 0.0, 0.0), 0.0, radius=1e-4, flags=0)
    for (i, j), stiffness, length, dashpot in zip(
        arrays["springs"], arrays["stiffness"], arrays["rest_lengths"], arrays["dashpot"], strict=True
    ):
        builder.add_spring(int(i), int(j), float(stiffness / length), float(dashpot), 0.0)
    builder.spring_rest_length[:] = [float(length) for length in arrays["rest_lengths"]]
    return builder


def simulate(folder: str | Path, frames: int, drag: bool = True, device: str = "cpu") -> np.ndarray:
    """Positions of nodes [frames + 1, N, 3], m, with SolverSemiImplicit and the twin's own time step, from frame 0.

    The hands move as exported, and stay where their last frame is.
    """
    arrays, settings = load(folder)
    count = len(arrays["nodes"])
    model = build(folder).finalize(device=device)
    model.particle_grid = None  # Else particles push each other away.
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
