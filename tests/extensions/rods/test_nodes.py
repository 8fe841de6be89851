"""Nodes on a rod's edges, springs of hands that pull them, and the ground, against closed forms."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.extensions.rods.nodes import RodFrames, bind, placed
from neuspring.twin.rollout import roll_out
from tests.extensions.rods.make import rod
from tests.support.scenes import SCALARS

EXACT = 1e-12
G = 9.8
VERTICES, EDGE = 9, 0.05


def twin(
    nodes: np.ndarray,
    hand: np.ndarray,
    springs: list[tuple[int, int]],
    *,
    height: float = 1.0,
    ground: bool = False,
    gravity: float = G,
    stiffness: float = 200.0,
    rest: float = 0.02,
    drag: float = 0.0,
    friction: float = 0.0,
    **changes: object,
) -> Twin:
    """A straight rod along x, of 1 kg/m; springs pull its nodes [N, 3] to one hand [3], both relative to its first vertex."""
    x = np.stack([EDGE * np.arange(VERTICES), np.zeros(VERTICES), np.full(VERTICES, height)], axis=1)
    points = nodes + x[0]
    edge, place = bind(x, np.tile([0, 0, 1.0], (VERTICES - 1, 1)), points)
    own = {"bending": 0.01, "twisting": 0.01, "stretching": 1e4, "damping": 0.01, "axis": np.array([0, 0, 1.0])} | changes
    count = len(springs)
    topology = Topology(
        nodes=points,
        controllers=(hand + x[0])[None],
        springs=np.array(springs, np.int32).reshape(-1, 2),
        rest_lengths=np.full(count, rest),
        labels=np.zeros(len(points), np.int32),
    )
    scalars = dict.fromkeys(SCALARS, 0.0) | {"drag": drag, "ground_friction": friction, "contact_distance": 0.01}
    return Twin(
        topology=topology,
        material=Material(stiffness=np.full(count, stiffness), dashpot=np.zeros(count), **scalars),
        simulation=Simulation(frame_time=0.02, substeps=10, ground=ground, gravity=gravity),
        body=rod(x, edge=edge, place=place, **({"mass": np.full(VERTICES, EDGE)} | own)),  # type: ignore[arg-type]
    )


def test_nodes_return_from_their_places_in_all_frames_at_once():
    rng = np.random.default_rng(0)
    vertices = np.cumsum(rng.uniform(0.5, 1.0, (6, 3)), axis=0)
    along = np.diff(vertices, axis=0)
    m1 = np.cross(along, rng.normal(size=(5, 3)))
    m1 /= np.linalg.norm(m1, axis=1, keepdims=True)
    nodes = rng.uniform(-1, 6, (40, 3))
    edge, place = bind(vertices, m1, nodes)
    lanes = [torch.tensor(values)[None] for values in (vertices, m1, edge.astype(np.int64), place)]
    both = [torch.cat([values, values]) for values in lanes]
    both[0][1] += 1.0
    found = placed(*both).numpy()
    np.testing.assert_allclose(found, [nodes, nodes + 1.0], atol=10 * EXACT)


def test_a_spring_beside_the_line_turns_the_rod_about_itself():
    # The hand is beside and above the line, the node on top of it: only a turn about the line brings it nearer.
    node = np.array([[0.2, 0.0, 0.01]])
    body = twin(node, np.array([0.2, 0.03, 0.01]), [(0, 1)], gravity=0.0, rest=1e-3, stiffness=1.0, mass=np.full(VERTICES, 1e9))
    frames = RodFrames(body)
    x, v = torch.tensor(body.topology.nodes), torch.zeros(1, 3)
    hand = torch.tensor(body.topology.controllers)
    after, _ = frames.forward(x, v, hand, hand)
    # So heavy a rod does not move, yet the twist is in equilibrium at once: node and hand lie on one ray from the line.
    np.testing.assert_allclose(after.numpy()[0] - [0.2, 0, 1], 0.01 * np.array([0, 3, 1]) / np.sqrt(10), atol=2e-6)


def test_a_spring_beside_the_line_pulls_the_whole_rod_along_itself():
    # In one plane with the line, so that nothing turns it.
    node, hand = np.array([[0.21, 0.0, 0.01]]), np.array([0.26, 0.0, 0.05])
    body = twin(node, hand, [(0, 1)], gravity=0.0)
    frames = RodFrames(replace(body, simulation=replace(body.simulation, frame_time=1e-4, substeps=1)))
    held = torch.tensor(body.topology.controllers)
    frames.forward(torch.tensor(body.topology.nodes), torch.zeros(1, 3), held, held)
    gained = body.body.mass @ frames.solver.v[0].numpy()
    along = (hand - node[0]) / np.linalg.norm(hand - node[0])
    np.testing.assert_allclose(gained / np.linalg.norm(gained), along, atol=1e-3)


def test_a_hand_that_stays_leaves_a_damped_rope_where_it_is():
    # The rate of curvature is that of the state at the end of each substep: else damping drives a free rod apart.
    rng = np.random.default_rng(2)
    nodes = rng.uniform([0, -0.01, -0.01], [0.4, 0.01, 0.01], (8, 3))
    body = twin(nodes, np.array([0.2, 0, 0.03]), [(n, 8) for n in range(8)], gravity=0.0, damping=0.05)
    own = np.linalg.norm(body.topology.nodes - body.topology.controllers, axis=1)
    body = replace(body, topology=replace(body.topology, rest_lengths=own))
    hands = np.tile(body.topology.controllers, (40, 1, 1))
    hands[1:, 0, 1] += 1e-3
    moved = roll_out(body, hands).positions
    assert np.abs(moved - moved[0]).max() < 5e-3


def test_a_rope_on_the_ground_slides_as_friction_says():
    nodes = np.array([[0.2, 0.0, -0.01], [0.1, 0, 0.01], [0.3, 0.01, 0]])
    body = twin(nodes, np.array([0.2, 1, 1]), [], height=0.01, ground=True, friction=0.4)
    speed, frames = 0.5, 15
    moved = roll_out(body, np.tile(body.topology.controllers, (frames, 1, 1)), velocity=np.tile([0, speed, 0], (3, 1))).positions
    # It stops after v^2 / (2 mu g); half a substep of the speed is what the step decides.
    expected = speed**2 / (2 * 0.4 * G)
    np.testing.assert_allclose(moved[-1, :, 1] - moved[0, :, 1], expected, atol=speed * 0.002)
    np.testing.assert_allclose(moved[..., 2], np.tile(moved[0, :, 2], (frames, 1)), atol=1e-4)


def test_lanes_are_the_same_as_rods_alone():
    node = np.array([[0.2, 0.0, 0.0], [0.1, 0.005, 0]])
    one = twin(node, np.array([0.2, 0, 0.02]), [(0, 2), (1, 2)])
    soft = replace(one, body=replace(one.body, bending=0.1 * one.body.bending))
    hands = np.tile(one.topology.controllers, (5, 1, 1)).astype(np.float32)
    hands[:, 0, 1] += 0.01 * np.arange(5)
    together = RodFrames([one, soft])
    x, v = torch.tensor(one.topology.nodes).expand(2, -1, -1), torch.zeros(2, 2, 3)
    for begin, end in pairwise(hands):
        x, v = together.forward(x, v, *(torch.tensor(points).expand(2, -1, -1) for points in (begin, end)))
    for lane, body in enumerate((one, soft)):
        assert np.array_equal(x[lane].numpy(), roll_out(body, hands).positions[-1])
