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

VBD_ITERATIONS = 10
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


def _simulate_rod(folder: str | Path, frames: int, drag: bool, device: str) -> np.ndarray:
    arrays, settings = load(folder)
    model = build(folder).finalize(device=device)
    solver = newton.solvers.SolverVBD(model, iterations=VBD_ITERATIONS)
    now: Any = model.state()
    then: Any = model.state()
    control = model.control()
    steps = int(np.ceil(settings["frame_time"] / arrays["step"]))
    dt = settings["frame_time"] / steps
    path = np.concatenate([arrays["clamps"], np.repeat(arrays["clamps"][-1:], max(frames + 1 - len(arrays["clamps"]), 0), axis=0)])
    result = [arrays["nodes"]]
    for begin, end in itertools.pairwise(path[: frames + 1]):
        for step in range(steps):
            poses, speeds = now.body_q.numpy().copy(), now.body_qd.numpy().copy()
            poses[arrays["held"]] = begin + (end - begin) * (step + 1) / steps
            poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
            if drag:
                fast = np.linalg.norm(speeds[:, :3], axis=1, keepdims=True)
                speeds *= np.exp(-dt * (settings["drag"] + settings["drag_quadratic"] * fast))
            now.body_q.assign(poses)
            now.body_qd.assign(speeds)
            now.clear_forces()
            solver.step(now, then, control, None, dt)
            now, then = then, now
        poses = now.body_q.numpy()[arrays["rod_edge"]].astype(float)
        place = arrays["rod_place"]
        local = np.stack([place[:, 1], place[:, 2], (place[:, 0] - 0.5) * arrays["rod_lengths"][arrays["rod_edge"]]], axis=1)
        turned = 2 * np.cross(poses[:, 3:6], local)
        result.append(poses[:, :3] + local + poses[:, 6:] * turned + np.cross(poses[:, 3:6], turned))
    return np.stack(result)


def simulate(folder: str | Path, frames: int, drag: bool = True, device: str = "cpu") -> np.ndarray:
    """Positions of nodes [frames + 1, N, 3], m, with SolverSemiImplicit and the twin's own time step, from frame 0.

    The hands move as exported, and stay where their last frame is. A rod takes SolverVBD.
    """
    arrays, settings = load(folder)
    if "rod_vertices" in arrays:
        return _simulate_rod(folder, frames, drag, device)
    model = build(folder).finalize(device=device)
    model.particle_grid = None  # Else particles push each other away.
    solver = newton.solvers.SolverSemiImplicit(model)
    now: Any = model.state()
    then: Any = model.state()
    count, substeps = len(arrays["nodes"]), settings["substeps"]
    dt = settings["frame_time"] / substeps
    hands = arrays["hands"]
    path = np.concatenate([hands, np.repeat(hands[-1:], max(frames + 1 - len(hands), 0), axis=0)]).astype(float)
    result = [arrays["nodes"]]
    for begin, end in itertools.pairwise(path[: frames + 1]):
        for step in range(substeps):
            places, speeds = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy()
            places[count:] = begin + (end - begin) * (step + 1) / substeps
            speeds[count:] = (end - begin) / settings["frame_time"] * settings["controller_velocity"]
            now.particle_q.assign(places)
            now.particle_qd.assign(speeds)
            now.clear_forces()
            solver.step(now, then, None, None, dt)
            if drag:
                fast = then.particle_qd.numpy()[:count].astype(float)
                slow = fast * np.exp(-dt * settings["drag"])
                speeds[:count], places[:count] = slow, places[:count] + dt * slow
                then.particle_q.assign(places)
                then.particle_qd.assign(speeds)
            now, then = then, now
        result.append(now.particle_q.numpy()[:count].copy())
    return np.stack(result)
