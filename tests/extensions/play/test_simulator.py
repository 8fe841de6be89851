"""A pulled twin, its controllers, and the time of a recording."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.extensions.play.colors import Scale, linear
from neuspring.extensions.play.live import FASTEST_GRAB, Grab, nearest_to_ray
from neuspring.extensions.play.player import Clock
from neuspring.extensions.play.simulator import Simulator, hands_of
from neuspring.physics import stability
from tests.support import small

NODE, STEP = 3, 0.008
"""The node that is pulled, and m per frame of a pull."""


@pytest.fixture(scope="module")
def twin():
    return small.scene().truth


def pulled(simulator, frames):
    """Positions [frames + 1, N, 3] under a pull along x, released at half of the frames."""
    seen, start = [simulator.positions.copy()], simulator.positions[NODE].copy()
    for frame in range(frames):
        target = start + np.array([STEP * (frame + 1), 0, 0], np.float32)
        seen.append(simulator.step(simulator.hands, NODE if frame < frames // 2 else -1, target).copy())
    return np.stack(seen)


def test_a_grabbed_node_follows_a_released_one_swings_back_and_a_reset_repeats_it_bit_for_bit(twin):
    simulator = Simulator(twin)
    seen = pulled(simulator, 60)
    moved = seen[:, NODE, 0] - seen[0, NODE, 0]
    # The grab is as stiff as the node's own springs together: half of the way at least.
    assert 0.5 * 30 * STEP < moved[30] < 30 * STEP
    assert moved[60] < 0.5 * moved[30]
    stability.check(simulator._with_grab(NODE))
    simulator.reset()
    assert np.array_equal(pulled(simulator, 60), seen)


def test_a_twin_whose_hands_only_push_can_be_grabbed(twin):
    topology = twin.topology
    led = np.arange(len(topology.springs)) >= topology.object_spring_count
    grabbed = Simulator(replace(twin, topology=replace(topology, pushes=led)))._with_grab(NODE).topology
    assert grabbed.pushes.tolist() == [*led.tolist(), False], "the mouse pulls"


def grab():
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
    assert nearest_to_ray(np.array([[0.0, 0, 1], [0.1, 0, 5], [0.3, 0, 1]]), (0, 0, 0), (0.021, 0, 1)) == 1


def test_a_hand_moves_as_one_and_no_faster_than_allowed():
    one = grab()
    one.take(1, "hand", 1, (0, 0, 0))
    one.pull(1, (1, 0, 0))
    hands, node, _ = one.next(0.1, np.zeros((3, 3), np.float32), np.zeros(3))
    assert node == -1
    assert hands == pytest.approx(np.array([[0.1 * FASTEST_GRAB, 0, 0], [0.1 * FASTEST_GRAB, 0, 0], [0, 0, 0]]))


def test_places_and_nodes_that_are_none_are_ignored():
    one = grab()
    places = ((np.nan, 0, 0), (1e9, 0, 0), (0, 0), "here", None)
    assert not any(one.take(1, "node", 0, place) for place in places)
    assert not any(one.take(1, "node", index, (0, 0, 0)) for index in (-1, 5, None, 1.5))
    one.take(1, "node", 0, (0, 0, 0))
    for place in places:
        one.pull(1, place)
    assert np.array_equal(one.next(1.0, np.zeros((3, 3)), np.zeros(3))[2], np.zeros(3))


def test_hands_are_those_that_the_capture_groups_and_else_those_that_are_near():
    places = np.array([[0.0, 0, 0], [0.01, 0, 0], [1.0, 0, 0]])
    assert hands_of(places, np.zeros(0, np.int32)).tolist() == [0, 0, 1]
    assert hands_of(places, np.array([3, -1, 3])).tolist() == [1, 0, 1], "numbered from 0"


def test_time_runs_at_the_recorded_rate_starts_again_and_names_the_part():
    clock = Clock(count=10, rate=20.0, border=7, playing=True)
    assert not clock.advance(0.04) and clock.advance(0.02) and clock.frame == 1
    clock.advance(0.5)
    assert clock.frame == 1
    for frame, part in ((6, "training"), (7, "future"), (99, "future"), (-5, "training")):
        clock.show(frame)
        assert f"{part} frame {clock.frame} of 9" in clock.bar()


def test_stiffness_beyond_the_ends_has_the_color_of_the_end_and_light_is_linear():
    scale = Scale(10.0, 1000.0)
    low, below, high = scale.paint(np.array([10.0, 1.0, 1000.0]))
    assert np.array_equal(low, below) and not np.array_equal(low, high)
    assert "100" in scale.legend()
    assert linear(np.array([0, 188, 255], np.uint8)).tolist() == [0, 128, 255]
