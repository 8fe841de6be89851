"""Recordings of cables as other laboratories write them: unit, rate, up axis, order of markers, branches, lost markers."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding
from neuspring.extensions.rods import mocap
from neuspring.extensions.rods.checks import in_space
from neuspring.extensions.rods.settings import Mocap
from neuspring.intake.check import check_layout
from tests.support.real import FOLDER

ROW = ScenarioRow(scenario="cable", source="mocap", category="cable", path="x", self_collision=False, ground=False)
REAL = FOLDER / "mocap_dlo"
LONG, SAG = 0.8, 0.25
"""m: distance of the grips, and depth of the cable below them."""


def swinging(rate: float = 100.0, samples: int = 500, count: int = 13) -> np.ndarray:
    """[T, 3, n]: a parabola between two grips whose plane swings about their line as the pendulum that it is, noise 0.2 mm."""
    part = np.linspace(0, 1, count)
    deep = 4 * SAG * part * (1 - part)
    held = [0, 1, -2, -1]
    inner = np.delete(deep, held)
    time = np.arange(samples) / rate
    angle = 0.4 * np.cos(np.sqrt(9.81 * inner.sum() / (inner**2).sum()) * time)[:, None]
    y, z = deep * np.sin(angle), -deep * np.cos(angle)
    y[:, held], z[:, held] = 0.0, -deep[held]
    places = np.stack(np.broadcast_arrays(LONG * part, y, z), axis=1)
    places[:, 2] += 1.2
    return places + np.random.default_rng(5).normal(0, 2e-4, places.shape)


def branched(samples: int = 500) -> np.ndarray:
    """[T, 3, 18] of a trunk of twelve markers, and then two branches of three that hang from it."""
    trunk = swinging(samples=samples, count=12)
    down = -0.08 * np.array([0.0, 0.3, 0.95])[:, None] * np.arange(1, 4)
    return np.concatenate([trunk, trunk[:, :, [4]] + down, trunk[:, :, [7]] + down], axis=2)


def checked(folder: Path, data: Any, **settings: Any) -> list[Finding]:
    """All findings but notes; the reader refuses what has an error, and nothing else."""
    path = folder / "7.pkl"
    path.write_bytes(pickle.dumps(data, protocol=4))
    found = check_layout(path, Config(mocap=Mocap(**settings)))
    if any(one.level == "error" for one in found):
        with pytest.raises(InputError, match=r"7\.pkl"):
            mocap.read(ROW, path, Mocap(**settings))
    else:
        assert len(mocap.read(ROW, path, Mocap(**settings)).nodes)
    return [one for one in found if one.level != "note"]


@pytest.mark.parametrize("data", [swinging(), swinging()[:, :, ::-1], swinging()[:, [1, 0, 2]] * [[-1.0], [1.0], [1.0]]])
def test_a_right_recording_has_no_findings(tmp_path, data):
    assert checked(tmp_path, data) == []


def y_up(data: np.ndarray) -> np.ndarray:
    return data[:, [0, 2, 1]] * [[1.0], [1.0], [-1.0]]


@pytest.mark.parametrize(
    ("data", "name", "level", "value", "mends"),
    [
        (1000 * swinging(), "length of the cable", "error", 1000, {"unit": 0.001}),
        (swinging() / 0.0254, "length of the cable", "error", 1 / 0.0254, {"unit": 0.0254}),
        (y_up(swinging()), "up of the recording", "warning", 0.0, {"up": "+y"}),
        (-swinging()[:, [1, 0, 2]], "up of the recording", "warning", -1.0, {"up": "-z"}),
        (swinging(rate=240.0), "rate of the recording", "warning", (100 / 240) ** 2, {"rate": 240.0}),
        (swinging(rate=30.0, samples=150), "rate of the recording", "warning", (100 / 30) ** 2, {"rate": 30.0}),
    ],
)
def test_unit_rate_and_up_are_held_against_the_data(tmp_path, data, name, level, value, mends):
    found = [one for one in checked(tmp_path, data) if one.name != "markers on one place"]
    (one,) = found
    assert (one.name, one.level) == (name, level)
    assert one.value == pytest.approx(value, rel=0.1, abs=0.05)
    setting = next(iter(mends))
    assert f"mocap.{setting}" in one.text and f"{mends[setting]:g}" if setting != "up" else mends["up"] in one.text
    assert checked(tmp_path, data, **mends) == []


def test_settings_are_applied_by_the_reader(tmp_path):
    path, data = tmp_path / "7.pkl", swinging()
    path.write_bytes(pickle.dumps(1000 * y_up(data), protocol=4))
    seen = mocap.read(ROW, path, Mocap(unit=0.001, up="+y", rate=50.0, stride=1, start=1))
    assert seen.scenario.frame_rate == 50.0
    np.testing.assert_allclose(seen.object_points, data[1:, :, 2:-2].transpose(0, 2, 1), atol=1e-6)
    np.testing.assert_allclose(seen.velocity_before[:9], (data[1] - data[0])[:, 2:-2].T * 50.0, atol=1e-4)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_a_recording_is_turned_and_never_mirrored(up):
    turned = in_space(np.eye(3)[None], Mocap(up=up))[0]
    assert np.linalg.det(turned) == 1 and turned[2, "xyz".index(up[1])] == (1 if up[0] == "+" else -1)


@pytest.mark.parametrize("order", [[0, 1, 3, 2, *range(4, 13)], np.random.default_rng(0).permutation(13).tolist()])
def test_columns_in_another_order_are_named(tmp_path, order):
    (found,) = checked(tmp_path, swinging()[:, :, order])
    assert (found.name, found.level) == ("order along the cable", "error") and found.value > 1.5
    proposed = [int(k) for k in found.text.rpartition("data[:, :, [")[2].rstrip("].").split(",")]
    assert checked(tmp_path, swinging()[:, :, order][:, :, proposed]) == []


def test_a_branched_cable_is_refused(tmp_path):
    (found,) = checked(tmp_path, branched())
    assert (found.name, found.level) == ("order along the cable", "error") and found.value > 3
    assert "branches at markers 4, 7" in found.text
    # As DEFT's files are, and the way that the message says leads to the branch.
    rows = branched().transpose(1, 0, 2).reshape(3, -1)
    for form in (tuple(rows), [rows]):
        (found,) = checked(tmp_path, form)
        assert (found.name, found.level) == ("form of a recording", "error") and "reshape to (3, T, n)" in found.text
    np.testing.assert_array_equal(np.reshape(rows, (3, 500, -1)).transpose(1, 0, 2), branched())


def test_lost_and_exchanged_markers(tmp_path):
    data = swinging()
    data[np.arange(500) % 50 < 6, :, 6] = 0.0
    (found,) = checked(tmp_path, data)
    assert (found.name, found.level, found.value, len(found.frames)) == ("lost points as numbers", "error", 10, 60)
    data = swinging()
    data[200:, :, [4, 8]] = data[200:, :, [8, 4]]
    (found,) = checked(tmp_path, data)
    assert (found.name, found.level, found.frames) == ("labels swapped", "warning", (200,))


@pytest.mark.parametrize(("first", "end"), [(0, "first"), (0, "last"), (300, "last")])
def test_held_markers_exchanged_throughout_or_in_a_gap(tmp_path, first, end):
    data = swinging()
    pair = [0, 1] if end == "first" else [-1, -2]
    data[:, :, pair[1]] += 0.7 * (data[:, :, pair[0]] - data[:, :, pair[1]])
    data[first:, :, pair] = data[first:, :, pair[::-1]]
    # As after lost samples, all markers step farther than the two are apart.
    data[first:] += 0.03
    (found,) = checked(tmp_path, data)
    assert (found.name, found.level, found.frames) == ("order at the ends", "warning", tuple(range(first, 500)))
    assert f"the {end} three in frames {first} to 499" in found.text


@pytest.mark.skipif(not REAL.is_dir(), reason="the released recordings are not part of the repository")
@pytest.mark.parametrize("cable", ["DLO1", "DLO2", "DLO3", "DLO4"])
def test_released_recordings_have_no_findings(cable):
    for file in sorted((REAL / cable).glob("*/*.pkl"))[::7]:
        assert [one for one in check_layout(file) if one.level != "note"] == []
