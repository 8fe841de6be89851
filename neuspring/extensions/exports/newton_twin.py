"""An exported twin as a model of Newton 1.8. This file is complete: it needs NumPy, Newton and Warp, and the files beside it.

    model = build("my_twin").finalize()         # particles (nodes, then controllers) and springs, or the bodies of a rod
    positions = simulate("my_twin", frames=10)  # [11, N, 3], m

Newton's spring has the force ke (l - l0) + kd dl/dt, so ke = stiffness / rest length and kd = dashpot. Its particles have no drag:
`simulate` slows them after each step. Ground and collisions between nodes are left out.

A rod is a chain of rigid edges (`newton.Rod`), for SolverVBD: its iterations end before joints are stiff, unless a step is as short
as `step` in chain.npz. Masses are set here, since Newton would give each edge the mass of a capsule with two round ends.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

ROD_ITERATIONS = 10
"""Iterations of SolverVBD in a step."""


def load(folder: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and settings of an exported twin."""
    said = json.loads((Path(folder) / "description.json").read_text())
    if said["format"] not in ("neuspring-plain", "neuspring-rod") or said["version"] != 1:
        raise ValueError(
            f"{folder}: format neuspring-plain 1 or neuspring-rod 1 is required, received {said['format']} {said['version']}"
        )
    arrays: dict[str, np.ndarray] = {}
    for name in ("arrays.npz", "chain.npz") if said["format"] == "neuspring-rod" else ("arrays.npz",):
        with np.load(Path(folder) / name) as stored:
            arrays |= {key: stored[key] for key in stored.files}
    return arrays, {name: entry["value"] for name, entry in said["settings"].items()}


def build(folder: str | Path) -> newton.ModelBuilder:
    """Nodes as particles, controllers as particles that do not move by themselves, and springs; or the edges of a rod."""
    arrays, settings = load(folder)
    down = (0.0, 0.0, -settings["gravity"] * settings["up_sign"])
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=down)
    if "rod_vertices" in arrays:
        _add_rod(builder, arrays, settings["damping"])
        return builder
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


def _add_rod(builder: newton.ModelBuilder, chain: dict[str, np.ndarray], damping: float) -> None:
    """Edges as bodies; those in clamps have no mass and stay where they are put."""
    frames: dict[str, Any] = {name: chain[name].astype(np.float32) for name in ("quaternions", "rest_points", "rest_quaternions")}
    rod = newton.Rod(chain["points"].astype(np.float32), radius=1e-3, **frames)
    shape = newton.ModelBuilder.ShapeConfig(density=1.0, has_shape_collision=False)
    bodies, joints = builder.add_rod(rod=rod, cfg=shape, bend_stiffness=1.0, wrap_in_articulation=False)
    builder.add_articulation(joints)
    for joint, stiffness in zip(joints, chain["stiffness"].tolist(), strict=True):
        first = builder.joint_qd_start[joint]
        builder.joint_target_ke[first : first + 6] = stiffness
        builder.joint_target_kd[first : first + 6] = [0.0] * 3 + [damping * value for value in stiffness[3:]]
    for edge, (body, mass, length) in enumerate(zip(bodies, chain["mass"], chain["rod_lengths"], strict=True)):
        free = edge not in chain["held"]
        inertia = float(mass * length**2 / 4)  # Of masses at both ends. About the edge any will do, since twist is in balance.
        builder.body_mass[body], builder.body_inv_mass[body] = (float(mass), 1 / float(mass)) if free else (0.0, 0.0)
        builder.body_inertia[body] = wp.mat33(*(np.eye(3) * inertia * free).ravel())
        builder.body_inv_inertia[body] = wp.mat33(*(np.eye(3) / inertia * free).ravel())
    builder.color()


def simulate(folder: str | Path, frames: int, drag: bool = True, device: str = "cpu") -> np.ndarray:
    """Positions of nodes [frames + 1, N, 3], m, with SolverSemiImplicit and the twin's own time step, from frame 0.

    The hands move as exported, and stay where their last frame is. A rod takes SolverVBD and the step of chain.npz.
    """
    arrays, settings = load(folder)
    count, is_rod = len(arrays["nodes"]), "rod_vertices" in arrays
    model = build(folder).finalize(device=device)
    model.particle_grid = None  # Else particles push each other away.
    solvers: Any = newton.solvers
    solver = solvers.SolverVBD(model, iterations=ROD_ITERATIONS) if is_rod else solvers.SolverSemiImplicit(model)
    now: Any = model.state()
    then: Any = model.state()
    control = model.control()
    steps = int(np.ceil(settings["frame_time"] / arrays["step"])) if is_rod else settings["substeps"]
    dt = settings["frame_time"] / steps
    led, hands = (arrays["held"], arrays["clamps"]) if is_rod else (slice(count, None), arrays["hands"])
    path = np.concatenate([hands, np.repeat(hands[-1:], max(frames + 1 - len(hands), 0), axis=0)]).astype(float)
    result = [arrays["nodes"]]
    for begin, end in itertools.pairwise(path[: frames + 1]):
        for step in range(steps):
            place, speed = (now.body_q, now.body_qd) if is_rod else (now.particle_q, now.particle_qd)
            places, speeds = place.numpy().copy(), speed.numpy().copy()
            places[led] = begin + (end - begin) * (step + 1) / steps
            if not is_rod:
                speeds[led] = (end - begin) / settings["frame_time"] * settings["controller_velocity"]
            else:
                places[:, 3:] /= np.linalg.norm(places[:, 3:], axis=1, keepdims=True)
                if drag:
                    fast = np.linalg.norm(speeds[:, :3], axis=1, keepdims=True)
                    speeds *= np.exp(-dt * (settings["drag"] + settings["drag_quadratic"] * fast))
            place.assign(places)
            speed.assign(speeds)
            now.clear_forces()
            solver.step(now, then, control, None, dt)
            if drag and not is_rod:
                slow = then.particle_qd.numpy()[:count].astype(float) * np.exp(-dt * settings["drag"])
                speeds[:count], places[:count] = slow, places[:count] + dt * slow
                then.particle_q.assign(places)
                then.particle_qd.assign(speeds)
            now, then = then, now
        result.append(_along(now.body_q.numpy(), arrays) if is_rod else now.particle_q.numpy()[:count].copy())
    return np.stack(result)


def _along(poses: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Nodes [N, 3] where edges have these poses [E, 7]."""
    edge, place = arrays["rod_edge"], arrays["rod_place"]
    pose = poses[edge].astype(float)
    local = np.stack([place[:, 1], place[:, 2], (place[:, 0] - 0.5) * arrays["rod_lengths"][edge]], axis=1)
    turned = 2 * np.cross(pose[:, 3:6], local)
    return np.asarray(pose[:, :3] + local + pose[:, 6:] * turned + np.cross(pose[:, 3:6], turned))
