"""A twin that is pulled: the grab, recordings that give the same motion again, and what another twin makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.physics import stability
from neuspring.play.controls import Controls, compare, digest_motion, load_controls, replay
from neuspring.play.live import FASTEST, Grab, nearest_to_ray
from neuspring.play.simulator import Simulator
from tests.support import small
from tests.support.played import softer

FRAMES, NODE = 12, 3
STEP = 0.008
"""m per frame of a pull."""


@pytest.fixture(scope="module")
def twin() -> Twin:
    return small.scene().truth


def pulled(twin: Twin, frames: int = FRAMES) -> tuple[Controls, np.ndarray]:
    """A pull along x, released at half of the frames, and the motion."""
    simulator = Simulator(twin)
    seen, rows = [simulator.positions], []
    start = simulator.positions[NODE]
    for frame in range(frames):
        node = NODE if frame < frames // 2 else -1
        target = start + np.array([STEP * (frame + 1), 0, 0], np.float32)
        rows.append((twin.topology.controllers, node, target))
        seen.append(simulator.step(*rows[-1]).copy())
    hands, grabbed, target = (np.stack([np.asarray(row[column]) for row in rows]) for column in range(3))
    names = {"scenario": "small", "method": "truth", "seed": "0", "twin_digest": "0"}
    motion = digest_motion(np.stack(seen))
    return Controls(hands=hands, grabbed=grabbed.astype(np.int32), target=target, motion_digest=motion, **names), np.stack(seen)


def test_a_grabbed_node_follows_and_a_released_one_swings_back(twin):
    _, seen = pulled(twin, 60)
    moved = seen[:, NODE, 0] - seen[0, NODE, 0]
    # The grab is as stiff as the node's own springs together: half of the way at least.
    assert 0.5 * 30 * STEP < moved[30] < 30 * STEP
    assert moved[60] < 0.5 * moved[30]
    stability.check(Simulator(twin)._with_grab(NODE))


def test_a_saved_recording_gives_the_same_motion_bit_for_bit(twin, tmp_path):
    controls, seen = pulled(twin)
    controls.save(tmp_path / "controls.npz")
    again = replay(twin, load_controls(tmp_path / "controls.npz"))
    assert np.array_equal(again.positions, seen)
    assert digest_motion(again.positions) == controls.motion_digest


def test_the_difference_of_another_twin_is_that_of_its_own_motion(twin):
    controls, seen = pulled(twin)
    other = softer(twin, 0.5)
    result = compare(controls, twin, other)
    apart = np.linalg.norm(replay(other, controls).positions[1:].astype(float) - seen[1:], axis=2)
    assert result.frames == FRAMES + 1
    assert result.mean == pytest.approx(apart.mean()) and result.worst == pytest.approx(apart.max()) and result.mean > 1e-4
    assert compare(controls, twin, twin).worst == 0


def test_controls_of_another_twin_and_names_that_are_paths_are_refused(twin):
    controls, _ = pulled(twin)
    with pytest.raises(InputError, match="controllers"):
        replay(twin, replace(controls, hands=controls.hands[:, :0]))
    with pytest.raises(InputError, match="nodes must lie in"):
        replay(twin, replace(controls, grabbed=np.full(FRAMES, 10**6, np.int32)))
    with pytest.raises(InputError, match="a name must match"):
        replace(controls, method="../../etc")


def grab() -> Grab:
    return Grab(5, np.zeros((3, 3), np.float32), np.array([0, 0, 1]))


def test_one_browser_holds_at_a_time_and_a_closed_tab_lets_go():
    one = grab()
    assert one.take(1, "node", 2, (0, 0, 0))
    assert not one.take(2, "node", 3, (0, 0, 0))
    one.pull(2, (9, 9, 9))
    assert one.next(1.0, np.zeros((3, 3)), np.zeros(3))[2] == pytest.approx(0)
    one.release(2)
    assert one.node == 2
    one.release(1)
    assert one.node == -1 and one.take(2, "node", 3, (0, 0, 0))
    # The node nearest to the mouse's ray is the one that is taken.
    points = np.array([[0.0, 0, 1], [0.1, 0, 5], [0.3, 0, 1]])
    assert nearest_to_ray(points, (0, 0, 0), (0.021, 0, 1)) == 1


def test_a_hand_moves_as_one_and_no_faster_than_allowed():
    one = grab()
    one.take(1, "hand", 1, (0, 0, 0))
    one.pull(1, (1, 0, 0))
    hands, node, _ = one.next(0.1, np.zeros((3, 3), np.float32), np.zeros(3))
    assert node == -1
    assert hands == pytest.approx(np.array([[0.1 * FASTEST, 0, 0], [0.1 * FASTEST, 0, 0], [0, 0, 0]]))


def test_places_and_nodes_that_are_none_are_ignored():
    one = grab()
    places = ((np.nan, 0, 0), (1e9, 0, 0), (0, 0), "here", None)
    assert not any(one.take(1, "node", 0, place) for place in places)
    assert not any(one.take(1, "node", index, (0, 0, 0)) for index in (-1, 5, None, 1.5))
    one.take(1, "node", 0, (0, 0, 0))
    for place in places:
        one.pull(1, place)
    assert np.array_equal(one.next(1.0, np.zeros((3, 3)), np.zeros(3))[2], np.zeros(3))
