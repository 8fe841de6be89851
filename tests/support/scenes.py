"""Small scenes shared by the physics tests, and the two engines that simulate them: the NumPy reference and Warp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.physics import reference
from neuspring.physics.controllers import waypoints
from neuspring.physics.parameters import Parameters, pack
from neuspring.physics.reference import ReferenceTwin
from neuspring.physics.solver import FrameSolver
from tests.support.devices import CUDA
from tests.support.devices import DEVICES as DEVICES

WAYS = [
    pytest.param("cpu", False, id="cpu"),
    pytest.param("cpu", True, id="cpu-threads"),
    pytest.param("cuda:0", True, id="cuda:0", marks=CUDA),
]
"""(device, threads): the CPU also runs the kernels of a GPU, so that every machine tests them."""
MASSES = np.array([0.3, 1.7, 0.8, 2.1, 0.5, 0.6])
"""Masses of the six nodes of lively scenes, kg."""
VARIANTS: dict[str, dict[str, Any]] = {
    "free": {"on_ground": False},
    "ground": {},
    "self-collision": {"self_collision": True},
    "all": {"self_collision": True, "up": "-z", "controller_velocity": True},
    "masses": {"self_collision": True, "mass": MASSES},
    "pushes": {"pushes": True},
}
"""Options of `random_scene` that together reach every term."""
SCALARS = ("drag", "ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction", "contact_distance")
"""Arguments of `Material` without a default."""


@dataclass(frozen=True)
class Scene(ReferenceTwin):
    """A twin in float64 for both engines; the reference has no springs that only push."""

    pushes: np.ndarray | bool = False
    """True where each spring [S], or every one, acts only while it is shorter than at rest."""


Engine = Callable[[Scene, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def scene(
    nodes: int,
    springs: Any = (),
    rest_lengths: Any = (),
    *,
    stiffness: Any = 1.0,
    dashpot: Any = 0.0,
    drag: float = 0.0,
    ground: tuple[float, float] = (0.5, 0.3),
    contact: tuple[float, float] = (0.7, 0.3),
    contact_distance: float = 0.02,
    mass: Any = 1.0,
    pushes: bool = False,
    on_ground: bool = False,
    **simulation: Any,
) -> Scene:
    """A twin in float64; `ground` and `contact` are (e, mu). Defaults: no gravity, no ground, one substep per frame of 1 ms."""
    pairs = np.array(springs, np.int32).reshape(-1, 2)
    options: dict[str, Any] = {"frame_time": 1e-3, "substeps": 1, "gravity": 0.0, "ground": on_ground} | simulation
    return Scene(
        nodes=nodes,
        springs=pairs,
        rest_lengths=np.broadcast_to(np.asarray(rest_lengths, np.float64), len(pairs)),
        stiffness=np.broadcast_to(np.asarray(stiffness, np.float64), len(pairs)),
        dashpot=np.broadcast_to(np.asarray(dashpot, np.float64), len(pairs)),
        drag=drag,
        ground=ground,
        contact=contact,
        contact_distance=contact_distance,
        simulation=Simulation(**options),
        mass=mass,
        pushes=(pairs >= nodes).any(axis=1) & pushes,
    )


def tensors(scene: Scene, device: str = "cpu", dtype: torch.dtype = torch.float64) -> dict[str, torch.Tensor]:
    """A scene's physical parameters with the keyword names of `pack`."""
    values = {
        "stiffness": scene.stiffness,
        "rest_lengths": scene.rest_lengths,
        "dashpot": scene.dashpot,
        "drag": scene.drag,
        "ground_elasticity": scene.ground[0],
        "ground_friction": scene.ground[1],
        "contact_elasticity": scene.contact[0],
        "contact_friction": scene.contact[1],
        "contact_distance": scene.contact_distance,
        "mass": np.atleast_1d(scene.mass),
        "pushes": np.broadcast_to(scene.pushes, len(scene.springs)),
    }
    return {name: torch.tensor(np.array(value), dtype=dtype, device=device) for name, value in values.items()}


def packed(scene: Scene, device: str = "cpu", dtype: torch.dtype = torch.float64) -> Parameters:
    """A scene's parameters, packed."""
    return pack(**tensors(scene, device, dtype), substep=scene.simulation.substep)


def solver_for(
    scene: Scene | Sequence[Scene],
    controllers: int,
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    *,
    differentiable: bool = True,
    threads: bool | None = None,
) -> FrameSolver:
    """A FrameSolver with the scene's parameters set, or one of several scenes on the graph of the first."""
    options: dict[str, Any] = {"device": device, "dtype": dtype, "differentiable": differentiable, "threads": threads}
    if isinstance(scene, Scene):
        solver = FrameSolver(scene.springs, scene.nodes, controllers, scene.simulation, **options)
        solver.set_parameters(packed(scene, device, dtype))
        return solver
    solver = FrameSolver(scene[0].springs, scene[0].nodes, controllers, [body.simulation for body in scene], **options)
    each = [packed(body, device, dtype) for body in scene]
    solver.set_parameters({name: torch.stack([one[name] for one in each]) for name in each[0]})
    return solver


def warp(
    scene: Scene,
    x: np.ndarray,
    v: np.ndarray,
    controllers: np.ndarray,
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    *,
    differentiable: bool = False,
    threads: bool | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """`reference.rollout` with the Warp solver."""
    solver = solver_for(scene, controllers.shape[1], device, dtype, differentiable=differentiable, threads=threads)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(np.asarray(values), dtype=dtype, device=device)

    hands = waypoints(tensor(controllers))
    states = [(tensor(x), tensor(v))]
    for begin, end in pairwise(hands):
        states.append(solver.forward(*states[-1], begin, end))
    xs, vs = zip(*states, strict=True)
    return torch.stack(xs).cpu().numpy(), torch.stack(vs).cpu().numpy()


ENGINES = [pytest.param(reference.rollout, id="reference"), pytest.param(warp, id="warp")]


def no_hands(frames: int) -> np.ndarray:
    """Controllers [frames + 1, 0, 3] for scenes that nothing holds."""
    return np.zeros((frames + 1, 0, 3))


def random_scene(seed: int, nodes: int = 10, controllers: int = 2, frames: int = 3, **simulation: Any) -> tuple[Scene, ...]:
    """(scene, x0, v0, hands): a random net above and just in the ground, held and dragged, away from its rest lengths."""
    rng = np.random.default_rng(seed)
    up = -1.0 if simulation.get("up") == "-z" else 1.0
    x = rng.uniform(-0.04, 0.04, (nodes, 3))
    x[:, 2] = up * rng.uniform(0.002, 0.06, nodes)
    v = rng.uniform(-0.6, 0.6, (nodes, 3))
    start = rng.uniform(-0.05, 0.05, (controllers, 3)) + np.array([0, 0, up * 0.1])
    hands = start + np.cumsum(np.concatenate([[np.zeros((controllers, 3))], rng.uniform(-0.01, 0.01, (frames, controllers, 3))]), 0)
    inner = [(i, j) for i in range(nodes) for j in range(i + 1, nodes) if rng.random() < 0.4]
    outer = [(nodes + c, int(i)) for c in range(controllers) for i in rng.choice(nodes, 2, replace=False)]
    # Released order: controller springs have the controller first, object springs come first.
    springs = np.array(inner + outer, np.int32)
    ends = np.concatenate([x, start])[springs]
    rest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) * rng.uniform(0.8, 1.2, len(springs))
    options: dict[str, Any] = {"frame_time": 0.02, "substeps": 20, "gravity": 9.8, "on_ground": True} | simulation
    body = scene(
        nodes,
        springs,
        rest,
        stiffness=rng.uniform(20.0, 200.0, len(springs)),
        dashpot=rng.uniform(0.0, 5.0, len(springs)),
        drag=rng.uniform(0.5, 5.0),
        ground=(0.5, 0.3),
        contact=(0.7, 0.3),
        contact_distance=0.035,
        **options,
    )
    return body, x, v, hands


def twin_of(scene: Scene, x: np.ndarray, controllers: np.ndarray) -> Twin:
    """The scene as a Twin (rounded to float32), at rest positions x [N, 3] and controllers [C, 3]."""
    topology = Topology(
        nodes=x, controllers=controllers, springs=scene.springs, rest_lengths=scene.rest_lengths, labels=np.zeros(len(x), np.int32)
    )
    if np.any(scene.pushes):
        topology = replace(topology, pushes=np.asarray(scene.pushes))
    scalars = dict(zip(SCALARS, (scene.drag, *scene.ground, *scene.contact, scene.contact_distance), strict=True))
    mass = scene.mass if np.ndim(scene.mass) else ()
    material = Material(stiffness=scene.stiffness, dashpot=scene.dashpot, mass=np.array(mass, float), **scalars)
    return Twin(topology=topology, material=material, simulation=scene.simulation)
