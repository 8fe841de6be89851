"""The fit of a rod: planted cables are found again, on recordings of several lengths, with markers beside the line."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.rods import mocap
from neuspring.extensions.rods.fit import (
    Levenberg,
    Recordings,
    RodResult,
    RodSteps,
    Variables,
    choose_axis,
    fit_rod,
    in_order,
    require_unmirrored,
    search_rod,
)
from neuspring.extensions.rods.made import RodStart, line_of, of_markers, rod_twin
from neuspring.extensions.rods.settings import Mocap
from neuspring.twin.fit import FitProblem
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move
from tests.extensions.rods import ropes
from tests.support import scenarios
from tests.support.real import FOLDER

REAL = FOLDER / "mocap_dlo"
SETTINGS = config.Config(
    rod=RodStart(bending=0.02, twisting=0.02), fit=config.Fit(rod=RodSteps(horizons=(0,), rounds=5, every=1, robust=1e-3))
)
VERTICES = 8
AXIS = (0.0, 1.0, 0.0)
WITHOUT_MARKERS = replace(SETTINGS.fit.rod, markers=False)


def cable(name: str, seed: int, frames: int = 21) -> Observations:
    """A hanging line of markers every 10 cm, whose held ends wander smoothly; inner markers are still to be predicted."""
    rng = np.random.default_rng(seed)
    along = np.linspace(-1, 1, VERTICES)
    angles = 1.3 * np.sin(0.5 * np.pi * along) + 0.05 * rng.normal(size=VERTICES)
    edges = 0.1 * np.stack([np.cos(angles), 0.1 * rng.normal(size=VERTICES), np.sin(angles)], axis=1)
    line = np.cumsum(edges, axis=0) + np.array([0, 0, 0.5])
    held = np.array([0, 1, VERTICES - 2, VERTICES - 1])
    time = np.arange(frames)[:, None, None] * 0.02
    sway = 0.1 * np.sin(8 * time * rng.uniform(0.7, 1.3, 3) + rng.uniform(0, 6, 3)) * [1, 1, 0.5]
    hands = line[held] + np.where(np.arange(4)[:, None] < 2, sway - sway[:1], sway[:1] - sway)
    inner = np.repeat(line[None, 2:-2], frames, axis=0)
    about = {"name": name, "source": "mocap", "category": "cable", "frame_rate": 50.0, "ground": False}
    return scenarios.seen(inner, hands, about, tracks=inner, line=np.array([4, 5, 0, 1, 2, 3, 6, 7]))


def recorded(twin: Twin, observations: Observations) -> Observations:
    """The recording as a twin moves."""
    points = roll_out(move(twin, observations)[0], observations.controller_points).positions
    return replace(observations, object_points=points, tracks=points)


def planted(settings: RodSteps, seed: int, size: float) -> tuple[Twin, list[Observations], Variables, np.ndarray]:
    """A twin with random variables, and two recordings of it; the start, and the variables."""
    shapes = [cable("one", 0), cable("two", 1, frames=16)]
    variables = Variables.of(rod_twin(shapes[0], SETTINGS, AXIS), settings)
    q = size * variables.scale * np.random.default_rng(seed).normal(size=len(variables.scale))
    twin = variables.made(q)
    return twin, [recorded(twin, shape) for shape in shapes], variables, q


def fitted(twin: Twin, seen: list[Observations], **settings: object) -> RodResult:
    """A fit of the twin to all recordings."""
    return fit_rod(seen[0], seen[1:], twin, replace(SETTINGS.fit.rod, **settings))


def error(twin: Twin, seen: list[Observations]) -> float:
    """Mean distance, m."""
    found = [roll_out(move(twin, each)[0], each.controller_points).positions - each.object_points for each in seen]
    return float(np.mean([np.linalg.norm(each, axis=2).mean() for each in found]))


def test_a_planted_rod_is_found_and_predicts_another_recording():
    truth, seen, _, _ = planted(WITHOUT_MARKERS, 0, 0.5)
    start, search = rod_twin(seen[0], SETTINGS, AXIS), search_rod(seen[0], seen[1:], SETTINGS)
    result = fitted(search.twin, seen, markers=False)
    new = recorded(truth, cable("three", 2))
    seen_before, seen_after = (error(twin, seen) for twin in (start, result.twin))
    assert seen_after < 0.25 * seen_before
    assert error(result.twin, [new]) < 0.6 * error(start, [new])
    losses = result.history["loss"].to_numpy()
    assert losses[-1] < losses[0]


def changed(seen: Observations, matrix: np.ndarray) -> Observations:
    """The recording in other axes."""
    names = ("object_points", "controller_points", "tracks")
    return replace(seen, **{name: (getattr(seen, name) @ matrix.T).astype(np.float32) for name in names})


@pytest.mark.parametrize("angle", [37.0, 95.0, 127.0, 180.0, -100.0])
def test_a_cable_that_was_recorded_elsewhere_has_its_axis_there(angle):
    twin, turn = rod_twin(cable("one", 0), SETTINGS, AXIS), Rotation.from_euler("z", angle, degrees=True).as_matrix()
    there = move(twin, changed(cable("one", 0), turn))[0]
    within = abs(angle) < 90
    np.testing.assert_allclose(there.rod.axis, AXIS if within else turn @ AXIS, atol=1e-5)
    if not within:
        # It is the same rod there: nodes have their places, and it moves as here.
        np.testing.assert_allclose(there.rod.place, twin.body.place, atol=1e-5)
        hands = cable("one", 0).controller_points
        here, moved = roll_out(twin, hands).positions, roll_out(there, hands @ turn.T).positions
        np.testing.assert_allclose(moved, here @ turn.T, atol=1e-4)


def test_recordings_without_a_world_in_common_take_their_axis_along():
    lines = [line_of(cable("one", seed)) for seed in range(5)]
    turns = [Rotation.from_euler("z", angle, degrees=True).as_matrix() for angle in (0, 100, 150, -90, 170)]
    oblique = Rotation.from_euler("z", 135, degrees=True).as_matrix()
    axis, steady = choose_axis([line @ turn.T for line, turn in zip(lines, turns, strict=True)])
    assert steady == 0.0
    assert choose_axis(lines)[1] > 1.0
    # Of a whole pool that was turned, no axis of the world will do: that across the cables.
    np.testing.assert_allclose(choose_axis([line @ oblique.T for line in lines])[0] @ oblique @ [1, 0, 0], 0.0, atol=0.1)
    np.testing.assert_allclose(axis, AXIS, atol=1e-6)


@pytest.mark.parametrize("end", [(0.0, 1.0, 0.0), (0.0, -0.999, 0.04), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_ends_may_lie_along_any_axis(end):
    seen = cable("one", 0)
    hands = seen.controller_points.copy()
    hands[:, 0] = hands[:, 1] - 0.1 * np.array(end)
    seen = replace(seen, controller_points=hands)
    for twin in (rod_twin(seen, SETTINGS, AXIS), move(rod_twin(cable("two", 1), SETTINGS, AXIS), seen)[0]):
        assert np.isfinite(roll_out(twin, hands).positions).all()


def test_a_recording_from_the_other_end_is_turned_round_and_said(capsys):
    """The distances between markers are the cable's."""
    seen = [uneven(cable(str(seed), seed)) for seed in range(4)]
    other = replace(seen[2], object_points=seen[2].object_points[:, ::-1], controller_points=seen[2].controller_points[:, ::-1])
    found = in_order([seen[0], seen[1], other, seen[3]])
    np.testing.assert_array_equal(found[2].line, other.line[::-1])
    np.testing.assert_array_equal(line_of(found[2]), line_of(seen[2]))
    assert [one.line.tolist() for one in found[:2]] == [one.line.tolist() for one in seen[:2]]
    assert capsys.readouterr().out == "note: 2: by the distances between its markers their order is [7, 6, 5, 4, 3, 2, 1, 0]\n"
    with pytest.raises(InputError, match=r"first recording must be in the order of most; received \[7, 6, .*deform\.leave_out"):
        in_order([other, *seen[:2], seen[3]])


@pytest.mark.skipif(not REAL.is_dir(), reason="the released recordings are not part of the repository")
@pytest.mark.parametrize("name", ["DLO1", "DLO2", "DLO3", "DLO4"])
def test_released_recordings_turned_by_any_angle_and_from_the_other_end_are_laid(name, tmp_path):
    settings = Mocap(start=1, stride=1, rings=24, ring=3, grip="clamp", train_fraction=1.0)
    files = sorted((REAL / name / "train").glob("*.pkl"), key=lambda file: int(file.stem))[::8]
    seen, lines = [], []
    for number, file in enumerate(files):
        turn = Rotation.from_euler("z", 80 * number, degrees=True).as_matrix()
        data = turn @ np.asarray(load_pickle(file))
        lines.append(data[1].T)
        path = tmp_path / f"{number}.pkl"
        path.write_bytes(pickle.dumps(data[:, :, ::-1] if number == 3 else data, protocol=4))
        row = config.ScenarioRow(scenario=file.stem, source="mocap", category=name, path="x", self_collision=False, ground=False)
        seen.append(mocap.read(row, path, settings))
    found = in_order(seen)
    axis, steady = choose_axis([line_of(each) for each in found])
    twin = rod_twin(found[0], config.Config(), axis, steady)
    for number, (each, line) in enumerate(zip(found, lines, strict=True)):
        np.testing.assert_allclose(line_of(each), line, atol=1e-6)
        own = Rotation.from_euler("z", -80 * number, degrees=True).apply(np.array(of_markers(twin, each).rod.axis))
        # As the cables head in the recordings as they were: within 60 degrees of each other.
        assert steady == 0.0 and axis @ own > 0.5


def uneven(seen: Observations) -> Observations:
    """The recording at rest, its inner markers nearer to the first end."""
    points, hands = seen.object_points.copy(), np.repeat(seen.controller_points[:1], len(seen.controller_points), axis=0)
    points[:, 1:] -= 0.3 * np.diff(seen.object_points, axis=1)
    return replace(seen, object_points=points, controller_points=hands)


def test_one_recording_that_is_mirrored_is_refused():
    """A cable with an unloaded curvature to one side; a mirror image of all is another cable."""
    start = rod_twin(cable("0", 0), SETTINGS, AXIS)
    bent = replace(start, rod=replace(start.rod, curvature=np.tile([0.3, 0.3], (VERTICES, 1))))
    seen = [recorded(bent, cable(str(seed), seed)) for seed in range(4)]
    mirror = np.diag([1.0, -1.0, 1.0])
    settings = RodSteps(**vars(WITHOUT_MARKERS))
    require_unmirrored(Recordings.of(seen, bent), bent, settings, "cpu")
    with pytest.raises(InputError, match=r"must not be mirrored; received 2 \(\d.*mirror image 0\.\d mm\)\. Correct.*leave_out"):
        require_unmirrored(Recordings.of([*seen[:2], changed(seen[2], mirror), seen[3]], bent), bent, settings, "cpu")


def test_markers_beside_the_line_are_found():
    truth, seen, _, _ = planted(SETTINGS.fit.rod, 3, 0.3)
    start = rod_twin(seen[0], SETTINGS, AXIS)
    without, with_markers = (fitted(start, seen, markers=markers).twin for markers in (False, True))
    new = recorded(truth, cable("three", 2))
    assert error(with_markers, seen) < 0.5 * error(without, seen)
    # The twin is in frame 0 of its own recording, and rolls out as it was fitted.
    own = roll_out(with_markers, seen[0].controller_points).positions
    np.testing.assert_allclose(own, roll_out(move(with_markers, seen[0])[0], seen[0].controller_points).positions, atol=1e-5)
    # In frame 0 markers lie where they were seen, whatever the line is.
    moved = move(with_markers, new)[0]
    np.testing.assert_allclose(moved.topology.nodes, new.nodes, atol=1e-6)
    assert np.abs(moved.rod.vertices[2:-2] - new.nodes).max() > 1e-3


def test_a_hand_that_lets_go_does_not_pull_in_the_fit_either():
    whole = ropes.rope(frames=8, move=(0.0, 0.02, 0.01))
    valid = np.ones(whole.controller_points.shape[:2], dtype=bool)
    valid[3:] = False
    seen = replace(whole, controller_valid=valid)
    twin = rod_twin(seen, ropes.SETTINGS)
    found = Recordings.of([seen], twin).predicted([twin], seen.scenario.train_end, 1, "cpu")[0, 0]
    rolled = roll_out(twin, seen.controller_points, valid=valid).positions[1 : 1 + len(found)]
    np.testing.assert_allclose(found, rolled, atol=1e-5)
    assert np.abs(roll_out(twin, seen.controller_points).positions[1 : 1 + len(found)] - rolled).max() > 1e-3


def test_what_a_rod_cannot_be_fitted_to_is_refused():
    rope = ropes.rope()
    with pytest.raises(InputError, match=r"markers along the line.*rod_single"):
        search_rod(rope, [rope], ropes.SETTINGS)
    twin = rod_twin(cable("one", 0), SETTINGS, AXIS)
    settings = {name: getattr(SETTINGS, name) for name in ("fit", "simulation", "losses")} | {"quirks": SETTINGS.released_quirks}
    with pytest.raises(InputError, match="a rod is fitted as rod; received field"):
        FitProblem(observations=cable("one", 0), twin=twin, kind="field", **settings)


def test_slopes_are_derivatives_of_rollouts():
    """Those of half the step agree within the step's own error, in all variables."""
    _, seen, variables, q = planted(replace(SETTINGS.fit.rod, stiffness="knots", knots=4), 5, 0.2)
    solver = Levenberg(Recordings.of(seen, variables.twin), SETTINGS.fit.rod)
    base = solver.errors(variables, [q], 10, 1)[0]
    slopes = [(solver.errors(variables, list(q + step * np.diag(variables.scale)), 10, 1) - base) / step for step in (1e-3, 5e-4)]
    apart = np.abs(slopes[1] - slopes[0]).max(axis=1) / (np.abs(slopes[0]).max(axis=1) + 1e-6)
    assert apart.max() < 0.02, dict(zip(np.repeat(list(variables.sizes), list(variables.sizes.values())), apart, strict=False))


def test_recordings_share_a_launch_and_shorter_ones_count_less():
    _, seen, variables, q = planted(WITHOUT_MARKERS, 1, 0.3)
    together = Levenberg(Recordings.of(seen, variables.twin), WITHOUT_MARKERS)
    errors = together.errors(variables, [q, 0 * q], 21, 1)
    assert errors.shape == (2, 4 * 3 * (20 + 15))
    assert np.abs(errors[0]).max() < 1e-5, "the planted twin leaves nothing"
    alone = Levenberg(Recordings.of(seen[:1], variables.twin), WITHOUT_MARKERS).errors(variables, [0 * q], 21, 1)
    np.testing.assert_array_equal(errors[1].reshape(-1)[: alone.size], alone[0])
    threads = Levenberg(Recordings.of(seen, variables.twin), WITHOUT_MARKERS, threads=2)
    np.testing.assert_array_equal(threads.errors(variables, [q, 0 * q], 21, 1), errors)


def test_fields_along_the_arc():
    twin = rod_twin(cable("one", 0), SETTINGS, AXIS)
    sizes = {}
    for kind in ("constant", "knots", "free"):
        variables = Variables.of(twin, replace(WITHOUT_MARKERS, stiffness=kind, curvature=kind, knots=4))
        sizes[kind] = variables.sizes.get("bending_along", 0), variables.sizes["curvature"]
        # A constant is in each of them.
        made = variables.made(np.zeros(len(variables.scale)))
        np.testing.assert_array_equal(made.rod.bending, twin.body.bending)
    assert sizes == {"constant": (0, 2), "knots": (4, 8), "free": (6, 12)}
