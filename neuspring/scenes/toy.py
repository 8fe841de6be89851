"""Toy scenes with known truth: a rope, a cloth and a blob, simulated by the float64 reference.

The path of a scene in the scenario table is `shape/motion/field`:

- shape: rope, cloth or blob
- motion: lift (up and back down) or shake (sideways, growing)
- field: smooth or two_region, the spatial distribution of the true stiffness

Observations contain noise and occlusion. The truth (a Twin) is stored separately, for studies of identifiability.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.config import Config, ScenarioRow, Toy
from neuspring.core.artifacts import Material, Observations, Scenario, Simulation, Topology, Twin
from neuspring.core.errors import InputError
from neuspring.intake.points import in_both
from neuspring.physics import reference, stability
from neuspring.physics.topology import uniform_topology

TRAIN_FRACTION = 0.7
TOY_FRAME_RATE = 30.0
TOY_OCCLUSION = (3, 8)
"""Shortest and longest occlusion, frames."""
TOY_ANNOTATED = 16
"""Number of tracks for scoring; they have no noise."""


@dataclass(frozen=True, kw_only=True)
class ToyObservation(Toy):
    """The settings of toy scenes, and the imperfections of their observations."""

    noise: float = 0.0005
    """Standard deviation of the observation noise, m."""
    occlusion: float = 0.2
    """Fraction of hidden point-frames, in runs of several frames."""
    seed: int = 0
    """Seed of noise and occlusion, combined with the scenario's name."""


@dataclass(frozen=True)
class Shape:
    """An object at rest: nodes in canonical order (tracked, surface, interior), controllers (`hands`) and connections. Meters."""

    tracked: np.ndarray
    surface: np.ndarray
    interior: np.ndarray
    hands: np.ndarray
    radius: float
    neighbors: int
    stiffness: float
    """Mean true stiffness, N."""
    along: np.ndarray
    """Unit vector along which the stiffness varies."""


def rope() -> Shape:
    """A rope of 0.6 m on the ground, four nodes per ring every 2 cm, held at one end."""
    angle = np.arange(4) * np.pi / 2 + np.pi / 4
    ring = 0.008 * np.stack([np.zeros(4), np.cos(angle), np.sin(angle)], axis=1)
    center = np.stack([np.linspace(0, 0.6, 31), np.zeros(31), np.full(31, 0.008)], axis=1)
    nodes = (center[:, None] + ring).reshape(-1, 3)
    upper = np.tile(ring[:, 2] > 0, len(center))
    hands = np.array([[0.0, 0.0, 0.012], [0.01, 0.006, 0.008], [0.01, -0.006, 0.008]])
    return Shape(nodes[upper], nodes[~upper], np.zeros((0, 3)), hands, 0.05, 18, 1.2e4, np.array([1.0, 0.0, 0.0]))


def cloth() -> Shape:
    """A sheet of 0.28 m x 0.28 m hanging from two corners, a node every 2 cm."""
    across, down = np.meshgrid(np.linspace(-0.14, 0.14, 15), np.linspace(0.4, 0.12, 15), indexing="ij")
    nodes = np.stack([across.ravel(), np.zeros(across.size), down.ravel()], axis=1)
    seen = np.add.outer(np.arange(15), np.arange(15)).ravel() % 2 == 0
    offsets = np.array([[0.0, 0.005, 0.004], [0.0, -0.005, 0.004], [0.004, 0.0, 0.006]])
    hands = np.concatenate([np.array([x, 0.0, 0.4]) + offsets for x in (-0.14, 0.14)])
    return Shape(nodes[seen], nodes[~seen], np.zeros((0, 3)), hands, 0.045, 14, 2e3, np.array([0.0, 0.0, 1.0]))


def blob() -> Shape:
    """An ellipsoid of 0.22 x 0.16 x 0.14 m standing on the ground, nodes on a 2.5 cm grid, held at the top."""
    half = np.array([0.11, 0.08, 0.07])
    axes = [np.arange(-h, h + 1e-9, 0.025) for h in half]
    grid = np.stack([g.ravel() for g in np.meshgrid(*[a - a.mean() for a in axes], indexing="ij")], axis=1)
    level = np.linalg.norm(grid / half, axis=1)
    body, level = grid[level <= 1.0], level[level <= 1.0]
    outer = level > 0.7
    lifted = body + np.array([0.0, 0.0, 0.002 - body[:, 2].min()])
    shell, interior = lifted[outer], lifted[~outer]
    facing = shell[:, 1] <= 0.01
    top = np.array([0.0, 0.0, lifted[:, 2].max() + 0.012])
    hands = top + np.array([[0.012, 0.0, 0.0], [-0.012, 0.0, 0.0], [0.0, 0.012, 0.0], [0.0, -0.012, 0.0]])
    return Shape(shell[facing], shell[~facing], interior, hands, 0.046, 18, 1.5e3, np.array([1.0, 0.0, 0.0]))


SHAPES = {"rope": rope, "cloth": cloth, "blob": blob}
MOTIONS = ("lift", "shake")
FIELDS = ("smooth", "two_region")


def hand_motion(kind: str, hands: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Controller positions [T, C, 3], m, from rest. lift: 20 cm up and halfway back; shake: sideways, growing to 8 cm."""
    phase = times / times[-1]
    move = np.zeros((len(times), 3))
    if kind == "lift":
        move[:, 2] = 0.2 * np.sin(np.pi * np.minimum(1.5 * phase, 1.5) / 2) ** 2
        move[:, 0] = 0.05 * np.sin(np.pi * phase) ** 2
    else:
        move[:, 1] = 0.08 * phase * np.sin(2 * np.pi * 1.2 * times)
        move[:, 2] = 0.1 * np.sin(np.pi * np.minimum(phase * 2, 1) / 2) ** 2
    return hands[None] + move[:, None]


def true_stiffness(kind: str, shape: Shape, topology: Topology) -> np.ndarray:
    """Stiffness [S], N, at spring midpoints: half to twice `shape.stiffness`, varying along `shape.along`."""
    ends = np.concatenate([topology.nodes, topology.controllers]).astype(np.float64)[topology.springs]
    position = ends.mean(axis=1) @ shape.along
    low, high = position.min(), position.max()
    unit = (position - low) / (high - low)
    level = np.sin(2 * np.pi * unit) if kind == "smooth" else np.where(unit < 0.5, 1.0, -1.0)
    return shape.stiffness * 2.0**level


@dataclass(frozen=True)
class ToyScene:
    """Observations for methods, and the truth behind them."""

    observations: Observations
    truth: Twin
    motion: np.ndarray
    """True node positions [T, N, 3], m."""


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.scenes.sources`. Writes the truth next to `output`; no method reads it."""
    scene = make(row, ToyObservation(**vars(config.toy)))
    scene.truth.save(output.with_name("truth.npz"))
    return scene.observations


def make(row: ScenarioRow, settings: ToyObservation) -> ToyScene:
    """Simulate and observe a scene; deterministic in `settings.seed` and the scenario's name.

    Raises InputError for unknown names.
    """
    parts = row.path.split("/")
    if len(parts) != 3 or parts[0] not in SHAPES or parts[1] not in MOTIONS or parts[2] not in FIELDS:
        rule = f"must be shape/motion/field with {sorted(SHAPES)} / {list(MOTIONS)} / {list(FIELDS)}"
        raise InputError(f"scenario {row.scenario}, path", rule, repr(row.path))
    shape = SHAPES[parts[0]]()
    truth = _true_twin(row, shape, parts[2])
    hands = hand_motion(parts[1], shape.hands, np.arange(settings.frames) / TOY_FRAME_RATE)
    rest = truth.topology.nodes.astype(np.float64)
    motion, _ = reference.rollout(reference.ReferenceTwin.of(truth), rest, np.zeros_like(rest), hands)
    return ToyScene(_observe(row, shape, motion, hands, settings), truth, motion)


def _true_twin(row: ScenarioRow, shape: Shape, field: str) -> Twin:
    nodes = np.concatenate([shape.tracked, shape.surface, shape.interior])
    topology = uniform_topology(nodes, shape.hands, shape.radius, shape.neighbors, 0.03, 12)
    count = len(topology.springs)
    material = Material(
        stiffness=true_stiffness(field, shape, topology),
        dashpot=np.full(count, 20.0),
        drag=1.0,
        ground_elasticity=0.2,
        ground_friction=0.5,
        contact_elasticity=0.5,
        contact_friction=0.3,
        contact_distance=0.01,
    )
    simulation = Simulation(
        frame_time=1.0 / TOY_FRAME_RATE, substeps=1, up="+z", ground=row.ground, self_collision=row.self_collision
    )
    twin = Twin(topology=topology, material=material, simulation=simulation)
    # Half of the stable step keeps the time-stepping error of the truth small.
    return stability.with_substeps(twin, stability.needed_substeps(twin, 0.25))


def _observe(row: ScenarioRow, shape: Shape, motion: np.ndarray, hands: np.ndarray, settings: ToyObservation) -> Observations:
    frames, tracked, surface = len(motion), len(shape.tracked), len(shape.surface)
    rng = np.random.default_rng([settings.seed, *row.scenario.encode()])
    noisy = motion + rng.normal(0.0, settings.noise, motion.shape)
    visible = _visibility(rng, frames, tracked, settings.occlusion)
    scenario = Scenario(
        name=row.scenario,
        source="toy",
        category=row.category,
        frame_count=frames,
        train_end=int(TRAIN_FRACTION * frames),
        frame_rate=TOY_FRAME_RATE,
        up="+z",
        ground=row.ground,
        self_collision=row.self_collision,
        provenance={
            "scene": row.path,
            "seed": str(settings.seed),
            "noise": f"{settings.noise} m",
            "occlusion": str(settings.occlusion),
        },
    )
    annotated = np.linspace(0, tracked - 1, min(TOY_ANNOTATED, tracked)).astype(int)
    return Observations(
        scenario=scenario,
        object_points=np.where(visible[..., None], noisy[:, :tracked], 0.0),
        object_visibility=visible,
        object_motion_valid=in_both(visible),
        controller_points=hands,
        surface_points=noisy[0, tracked : tracked + surface],
        interior_points=noisy[0, tracked + surface :],
        tracks=motion[:, annotated],
    )


def _visibility(rng: np.random.Generator, frames: int, points: int, fraction: float) -> np.ndarray:
    """[T, No] bool: each point is hidden in runs of several frames, in about `fraction` of its frames, but never in frame 0."""
    visible = np.ones((frames, points), dtype=bool)
    wanted = int(fraction * frames)
    for point in range(points):
        while (~visible[:, point]).sum() < wanted:
            start = int(rng.integers(1, frames))
            visible[start : start + int(rng.integers(*TOY_OCCLUSION)), point] = False
    return visible
