"""Tables of a hand's pose and markers: what is read, a rod that hangs from the hand, its fit, and faults that are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from neuspring import config
from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.extensions.rods import posed
from neuspring.extensions.rods.fit import RodSteps, Variables, fit_rod, search_rod
from neuspring.extensions.rods.made import RodStart, rod_twin
from neuspring.extensions.rods.settings import Posed
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move

MARKED = [(f"{name}x", f"{name}y", f"{name}z") for name in ("middle_", "end_")]
UNLOADED = ((0.25, 0.0, -0.01), (0.5, 0.0, -0.01))
POSED = Posed(markers=tuple(MARKED), unloaded=UNLOADED, radius=0.01)
ROD = RodStart(lay_out=9, bending=0.3, twisting=0.3, damping=0.02, substep=0.005)
SINGLE = 1e-6
"""m: observations are float32."""


def table(frames: int = 41, seed: int = 0, rate: float = 50.0) -> pd.DataFrame:
    """A hand that swings from rest and turns about all axes, and markers that are still to be predicted."""
    rng, time = np.random.default_rng(seed), np.arange(frames) / rate
    way = (1 - np.cos(2 * np.pi * rng.uniform(0.8, 1.5, 6) * time[:, None])) * rng.uniform(0.05, 0.25, 6)
    turns = Rotation.from_rotvec(way[:, 3:]) * Rotation.from_euler("y", -0.3)
    values = {"t": time, **dict(zip("xyz", (way[:, :3] * 0.5).T, strict=True))}
    values |= dict(zip(("qx", "qy", "qz", "qw"), turns.as_quat().T, strict=True))
    for columns, place in zip(MARKED, UNLOADED, strict=True):
        values |= dict(zip(columns, (turns.apply(place) + 0.5 * way[:, :3]).T, strict=True))
    return pd.DataFrame(values)


def seen(folder: Path, rows: pd.DataFrame, name: str = "swing", **settings: object) -> Observations:
    """Observations of a table."""
    rows.to_csv(folder / f"{name}.csv", index=False)
    row = ScenarioRow(scenario=name, source="posed", category="foam", path="", self_collision=False, ground=False)
    return posed.observe(row, folder / f"{name}.csv", Config(posed=replace(POSED, **settings)), folder / "observations.npz")


def recorded(twin: Twin, here: Observations) -> Observations:
    """The recording as a twin moves."""
    points = roll_out(move(twin, here), here.controller_points).positions[:, :2]
    return replace(here, object_points=points, tracks=points)


def test_a_hand_carries_its_points_and_the_unloaded_body_hangs_straight_from_it(tmp_path):
    rows = table()
    here = seen(tmp_path, rows)
    turns = Rotation.from_quat(rows[["qx", "qy", "qz", "qw"]].to_numpy())
    hand = here.controller_points.astype(float) - rows[["x", "y", "z"]].to_numpy()[:, None]
    own = np.stack([turns.inv().apply(hand[:, point]) for point in range(hand.shape[1])], axis=1)
    np.testing.assert_allclose(own, np.broadcast_to(own[0], own.shape), atol=SINGLE)
    along = np.array(UNLOADED[0]) / np.linalg.norm(UNLOADED[0])
    np.testing.assert_allclose(own[0, :2], [-posed.HAND_GRIP * along, [0, 0, 0]], atol=SINGLE)
    assert here.scenario.frame_rate == pytest.approx(50)
    assert here.line.tolist() == [74, 75, 0, 1]
    assert here.rest_shape.shape == (74 + 8, 3) and here.controller_hand.tolist() == [0] * 8
    rest = turns[0].inv().apply(here.rest_shape[:2] - rows[["x", "y", "z"]].to_numpy()[0])
    np.testing.assert_allclose(rest, UNLOADED, atol=SINGLE)


def test_angles_stride_and_gaps_of_markers(tmp_path):
    rows = table()
    angles = Rotation.from_quat(rows[["qx", "qy", "qz", "qw"]].to_numpy()).as_euler("ZYX")
    turned = rows.assign(**dict(zip(("z1", "y1", "x1"), angles.T, strict=True)))
    turned.loc[4, "end_x"] = np.nan
    here = seen(tmp_path, turned, rotation=("z1", "y1", "x1"), angles="ZYX", stride=2)
    np.testing.assert_allclose(here.controller_points, seen(tmp_path, rows).controller_points[::2], atol=SINGLE)
    assert not here.object_visibility[2, 1] and here.object_visibility.sum() == 2 * 21 - 1
    assert here.scenario.frame_rate == pytest.approx(25)


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lambda rows: rows.drop(columns="qz"), {}, r"no qz.*section posed"),
        (lambda rows: rows.assign(qw=2.0), {}, r"quaternions must have length 1.*posed\.angles"),
        (lambda rows: rows.drop(index=7), {}, r"time steps must be equal.*Resample"),
        (lambda rows: rows.assign(x=np.nan), {}, r"x: every entry must be a number"),
        (lambda rows: rows.assign(end_x=rows["end_x"].where(rows.index > 0)), {}, r"no marker 1.*Start the table"),
        (lambda rows: rows, {"unloaded": UNLOADED[:1]}, r"one unloaded position per marker.*1 and 2"),
        (lambda rows: rows, {"angles": "ZYX"}, r"posed\.rotation.*four columns"),
        (lambda rows: rows, {"stride": 20}, r"at least 5 samples"),
    ],
)
def test_faults_are_named_with_the_next_move(tmp_path, change, settings, message):
    with pytest.raises(InputError, match=message):
        seen(tmp_path, change(table()), **settings)


def test_a_rod_hangs_from_the_hand_in_frame_0_and_follows_its_turns(tmp_path):
    here = seen(tmp_path, table())
    twin = rod_twin(here, Config(rod=ROD))
    assert twin.body is not None and twin.body.held.tolist() == [0, 1] + 7 * [-1] and twin.body.rolls.tolist() == [2, -1]
    sag = here.rest_shape[:2] - twin.topology.nodes[:2]
    assert sag[1, 2] > sag[0, 2] > 0.005, "it hangs below the unloaded shape"
    moved = roll_out(twin, here.controller_points).positions
    np.testing.assert_array_equal(moved[0], twin.topology.nodes)
    again = roll_out(move(twin, here), here.controller_points).positions
    np.testing.assert_allclose(again, moved, atol=1e-5)
    # A hand that stays leaves it where it is: it began at rest.
    still = roll_out(twin, np.tile(here.controller_points[:1], (20, 1, 1))).positions
    np.testing.assert_allclose(still, still[:1].repeat(20, axis=0), atol=1e-5)
    # A stiff one follows as a rigid body.
    stiff = rod_twin(
        here, Config(rod=replace(ROD, bending=1e4, twisting=1e4, stretching=1e8), simulation=config.SimulationSettings(gravity=0.0))
    )
    path = roll_out(stiff, here.controller_points).positions[:, :2]
    np.testing.assert_allclose(path, here.object_points, atol=2e-3)


def test_a_fit_finds_stiffness_and_slip_of_a_rod_that_swings(tmp_path):
    first, second = (seen(tmp_path, table(61, seed), f"swing{seed}") for seed in (0, 1))
    steps = RodSteps(curvature="straight", horizons=(0,), rounds=12, every=2, markers=False, slip=1, robust=1e-3)
    start = rod_twin(first, Config(rod=ROD))
    start = replace(start, body=replace(start.body, slip=np.array([[0.5, 0.3]]), slip_twist=1.0))
    variables = Variables.of(start, steps, 2)
    names = variables.kinds.tolist()
    q = np.zeros(len(names))
    for name, value in (("bending", 0.4), ("slip_share", 0.5), ("slip_yield", -0.5)):
        q[names.index(name)] = value
    truth = variables.made(q)
    pool = [recorded(truth, each) for each in (first, second)]
    found = fit_rod(pool[0], pool[1:], start, steps).twin
    assert found.body is not None and truth.body is not None
    np.testing.assert_allclose(found.body.bending, truth.body.bending, rtol=0.1)
    np.testing.assert_allclose(found.body.slip, truth.body.slip, rtol=0.05)
    # A search finds the stiffness from far.
    far = search_rod(pool[0], pool[1:], Config(rod=replace(ROD, bending=30.0, twisting=30.0), fit=config.Fit(rod=steps)))
    assert np.median(far.twin.body.bending) == pytest.approx(float(np.median(truth.body.bending)), rel=0.5)
