"""A twin that is pulled: the grab, where it begins, hands that go on as recorded, recordings that give the same motion again,
and what another twin makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.extensions.play.controls import ControlRecorder, Controls, compare, digest_motion, load_controls, replay
from neuspring.extensions.play.live import FASTEST_GRAB, Grab, nearest_to_ray
from neuspring.extensions.play.simulator import Simulator, Start, hands_of, start_state
from neuspring.physics import stability
from neuspring.report.shown import find
from neuspring.twin.rollout import roll_out
from tests.extensions.rods import ropes
from tests.extensions.rods.ropes import rod_results
from tests.support import small
from tests.support.played import results, softer

FRAMES, NODE = 12, 3
NAMES = {"scenario": "small", "method": "truth", "seed": "0", "twin_digest": "0"}
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
    motion = digest_motion(np.stack(seen))
    return Controls(hands=hands, grabbed=grabbed.astype(np.int32), target=target, motion_digest=motion, **NAMES), np.stack(seen)


def test_a_grabbed_node_follows_and_a_released_one_swings_back(twin):
    _, seen = pulled(twin, 60)
    moved = seen[:, NODE, 0] - seen[0, NODE, 0]
    # The grab is as stiff as the node's own springs together: half of the way at least.
    assert 0.5 * 30 * STEP < moved[30] < 30 * STEP
    assert moved[60] < 0.5 * moved[30]
    stability.check(Simulator(twin)._with_grab(NODE))


def test_a_rod_is_pulled_and_let_go_in_one_motion_that_repeats_bit_for_bit():
    rod = ropes.twin()
    controls, seen = pulled(rod, 20)
    assert seen[10, NODE, 0] - seen[0, NODE, 0] > 5 * STEP, "the grabbed node follows"
    # The state passes from the solver of the grab to the one without: speed does not jump.
    speeds = np.linalg.norm(np.diff(seen[:, NODE], axis=0), axis=1)
    assert speeds[10] > 0.3 * speeds[9]
    assert np.array_equal(replay(rod, controls).positions, seen)


def test_a_rod_begins_at_frame_0_alone(tmp_path):
    found = find([rod_results(tmp_path)])
    (run,) = found.runs
    begin = start_state(run, found.observations, 0, True)
    simulator = Simulator(run.twin, begin.start)
    moved = np.stack([simulator.positions, *(simulator.step(hands).copy() for hands in begin.hands)])
    assert np.array_equal(moved, run.trajectory.positions)
    with pytest.raises(InputError, match="begins in frame 0"):
        start_state(run, found.observations, 3, True)


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


def test_a_twin_whose_hands_only_push_can_be_grabbed(twin):
    topology = twin.topology
    led = np.arange(len(topology.springs)) >= topology.object_spring_count
    grabbed = Simulator(replace(twin, topology=replace(topology, pushes=led)))._with_grab(NODE).topology
    assert grabbed.pushes.tolist() == [*led.tolist(), False], "the mouse pulls"


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
    assert nearest_to_ray(np.array([[0.0, 0, 1], [0.1, 0, 5], [0.3, 0, 1]]), (0, 0, 0), (0.021, 0, 1)) == 1


def test_hands_are_those_that_the_capture_groups_and_else_those_that_are_near():
    places = np.array([[0.0, 0, 0], [0.01, 0, 0], [1.0, 0, 0]])
    assert hands_of(places).tolist() == [0, 0, 1]
    assert hands_of(places, np.array([3, -1, 3])).tolist() == [1, 0, 1], "numbered from 0"
    # What is known of another number of controllers says nothing.
    assert hands_of(places, np.array([1, 1])).tolist() == [0, 0, 1]


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


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return find([results(tmp_path_factory.mktemp("begin"))])


def moved(simulator: Simulator, begin, node: int = -1, target=None) -> np.ndarray:
    """Nodes in the frames of a script [E + 1, N, 3]."""
    seen = [simulator.positions.copy()]
    for hands, holds in zip(begin.hands, begin.holds, strict=True):
        seen.append(simulator.step(hands, node, target, holds).copy())
    return np.stack(seen)


def test_hands_that_repeat_the_recording_give_its_prediction_bit_for_bit(found):
    run = found.runs[-1]
    begin = start_state(run, found.observations, 0, repeat=True)
    assert np.array_equal(moved(Simulator(run.twin, start=begin.start), begin), run.trajectory.positions)


def test_a_pull_goes_on_beside_the_recorded_hands(found):
    run = found.runs[-1]
    begin = start_state(run, found.observations, 0, repeat=True)
    node = int(np.argmax(run.trajectory.positions[-1, :, 0]))
    target = run.trajectory.positions[0, node] + [0, 0, 0.1]
    pulled = moved(Simulator(run.twin, start=begin.start), begin, node, target)
    assert np.linalg.norm(pulled[-1, node] - target) < np.linalg.norm(run.trajectory.positions[-1, node] - target) - 0.01


def test_it_begins_at_any_frame_in_the_state_of_the_prediction(found):
    run = found.runs[-1]
    x, seconds = run.trajectory.positions, run.twin.simulation.frame_time
    begin = start_state(run, found.observations, 3, repeat=True)
    assert np.array_equal(begin.start.positions, x[3]) and len(begin.hands) == len(x) - 4
    assert begin.start.velocity == pytest.approx((x[4].astype(float) - x[2]) / (2 * seconds))
    # Half of what the nodes move in two frames is not exactly the velocity, so that the motion differs by a little.
    apart = np.linalg.norm(moved(Simulator(run.twin, start=begin.start), begin) - x[3:], axis=2)
    travel = np.linalg.norm(x[-1] - x[3], axis=1).max()
    assert apart.max() < 0.25 * travel


def letting_go(frames: int, count: int) -> np.ndarray:
    """All hands hold, let go in frame 2, and the first one takes hold again in frame 4."""
    valid = np.ones((frames, count), bool)
    valid[2:4] = False
    valid[4:, 1:] = False
    return valid


@pytest.mark.parametrize("frame", [3, 4, 6])
def test_a_start_after_grips_knows_their_lengths(found, frame):
    run, seen = found.runs[-1], found.observations
    valid = letting_go(len(seen.controller_points), seen.controller_points.shape[1])
    seen = replace(seen, controller_valid=valid)
    expected, simulator = [], Simulator(run.twin)
    rolled = roll_out(run.twin, seen.controller_points, valid=valid).positions
    for row, holds in zip(seen.controller_points[1:], valid[1:], strict=True):
        simulator.step(row, holds=holds)
        expected.append((simulator.positions.copy(), simulator._v.numpy().copy()))
    positions = np.stack([run.twin.topology.nodes, *(x for x, _ in expected)])
    assert np.array_equal(positions, rolled) and not np.array_equal(positions, run.trajectory.positions)
    known = replace(run, paths={"twin": run.paths["twin"]})
    object.__setattr__(known, "trajectory", replace(run.trajectory, positions=positions))
    begin = start_state(known, seen, frame, repeat=True)
    exact = replace(begin.start, velocity=expected[frame - 1][1])
    assert np.array_equal(moved(Simulator(run.twin, start=exact), begin), positions[frame:])


def test_a_recording_from_a_frame_gives_the_same_motion_bit_for_bit(found, tmp_path):
    run = found.runs[-1]
    seen = found.observations
    valid = letting_go(len(seen.controller_points), seen.controller_points.shape[1])
    begin = start_state(run, replace(seen, controller_valid=valid), 5, repeat=True)
    simulator, recording = Simulator(run.twin, start=begin.start), ControlRecorder()
    recording.begin(simulator.positions)
    for number, (hands, holds) in enumerate(zip(begin.hands, begin.holds, strict=True)):
        node, target = (2, simulator.positions[2] + [0, 0, 0.02]) if number else (-1, np.zeros(3))
        x = simulator.step(hands, node, target, holds)
        recording.add((hands, node, target, simulator.holds), x)
    recording.controls(begin.start, begin.frame, **NAMES).save(tmp_path / "controls.npz")
    saved = load_controls(tmp_path / "controls.npz")
    assert saved.start_frame == 5 and len(saved.start.grip_rows) == 1
    assert np.array_equal(replay(run.twin, saved).positions[-1], simulator.positions)
    assert recording.motion_digest() == saved.motion_digest


def test_a_frame_without_prediction_and_a_start_of_another_twin_are_refused(found):
    run = found.runs[-1]
    for frame in (-1, 8):
        with pytest.raises(InputError, match="its prediction has 8 frames"):
            start_state(run, found.observations, frame, repeat=False)
    recording, simulator = ControlRecorder(), Simulator(run.twin)
    recording.begin(simulator.positions)
    hands = run.twin.topology.controllers
    recording.add((hands, -1, np.zeros(3), np.ones(len(hands), bool)), simulator.step(hands))
    start = Start(positions=np.zeros((2, 3)), velocity=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"start\.positions"):
        replay(run.twin, recording.controls(start, 0, **NAMES))


def test_a_recording_that_is_too_long_keeps_nothing(monkeypatch):
    monkeypatch.setattr("neuspring.extensions.play.controls.MOST_FRAMES", 2)
    recording, x, row = ControlRecorder(), np.zeros((3, 3)), (np.zeros((1, 3)), -1, np.zeros(3), np.ones(1, bool))
    recording.begin(x)
    assert [recording.add(row, x) for _ in range(4)] == [False, False, True, False]
    with pytest.raises(InputError, match="at least one frame"):
        recording.controls(Start(), 0, **NAMES)
