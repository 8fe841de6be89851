"""The fit of a rod: planted cables are found again, on recordings of several lengths, with markers beside the line."""

from dataclasses import replace

import numpy as np

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.extensions.rods.fit import (
    Levenberg,
    Recordings,
    RodResult,
    RodSteps,
    Variables,
    fit_rod,
    search_rod,
)
from neuspring.extensions.rods.made import RodStart, rod_twin
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move
from tests.extensions.rods import ropes
from tests.support import scenarios

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
    points = roll_out(move(twin, observations), observations.controller_points).positions
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
    found = [roll_out(move(twin, each), each.controller_points).positions - each.object_points for each in seen]
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


def test_markers_beside_the_line_are_found():
    truth, seen, _, _ = planted(SETTINGS.fit.rod, 3, 0.3)
    start = rod_twin(seen[0], SETTINGS, AXIS)
    without, with_markers = (fitted(start, seen, markers=markers).twin for markers in (False, True))
    new = recorded(truth, cable("three", 2))
    assert error(with_markers, seen) < 0.5 * error(without, seen)
    # The twin is in frame 0 of its own recording, and rolls out as it was fitted.
    own = roll_out(with_markers, seen[0].controller_points).positions
    np.testing.assert_allclose(own, roll_out(move(with_markers, seen[0]), seen[0].controller_points).positions, atol=1e-5)
    # In frame 0 markers lie where they were seen, whatever the line is.
    moved = move(with_markers, new)
    np.testing.assert_allclose(moved.topology.nodes, new.nodes, atol=1e-6)
    assert np.abs(moved.body.vertices[2:-2] - new.nodes).max() > 1e-3


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
        np.testing.assert_array_equal(made.body.bending, twin.body.bending)
    assert sizes == {"constant": (0, 2), "knots": (4, 8), "free": (6, 12)}
