"""Splats on a twin in the browser: they follow the nodes, in whatever order frames are shown."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

pytest.importorskip("viser", reason="the extra [play] is not installed")

from neuspring.core.artifacts import SplatCenters
from neuspring.play.layers import UNIT, SplatLayer, covariances
from neuspring.play.player import Player
from neuspring.play.results import find
from neuspring.splats.model import Gaussians
from neuspring.splats.view import C0
from tests.support.played import dressed

ROUNDING = 2e-3
"""Relative error of 16-bit floats, with a margin."""


def test_damaged_splats_are_a_note_and_the_run_is_shown(scenario, server):
    dressed(scenario)
    (scenario / "appearance" / "0" / "splats.ply").write_bytes(b"ply\n")
    run = find([scenario]).runs[0]
    assert "splats" not in run.paths and any("no splats" in note for note in run.notes)
    player = Player(server.scene, find([scenario]))
    player.display.splats = True
    player.apply()
    assert player._bodies["baseline/0"].splats is None


def test_they_turn_with_the_body(scenario, server):
    assert find([scenario]).runs[0].splats is None
    splats, run = dressed(scenario), find([scenario]).runs[0]
    nodes = run.trajectory.positions[0]
    assert np.array_equal(run.splats.means, splats.means)
    turn, shift = Rotation.from_rotvec([0.3, -0.8, 1.1]), np.array([0.5, 0.1, -0.2])
    layer = SplatLayer(server.scene, "turned", splats, nodes)
    means, quaternions = layer.carried(turn.apply(nodes) + shift)
    assert means == pytest.approx(turn.apply(splats.means) + shift, abs=1e-5)
    expected = turn.as_matrix() @ covariances(splats.quaternions, np.exp(splats.log_scales)) @ turn.as_matrix().T
    assert covariances(quaternions, np.exp(splats.log_scales)) == pytest.approx(expected, abs=1e-8)


def test_what_the_browser_gets_are_their_colors_and_sizes(scenario, server):
    splats, run = dressed(scenario, degree=2), find([scenario]).runs[0]
    layer = SplatLayer(server.scene, "colors", splats, run.trajectory.positions[0])
    handle = layer.handle
    assert handle.centers * UNIT == pytest.approx(splats.means, abs=1e-6)
    gaussians = Gaussians.of(splats)
    scales = torch.diag_embed(gaussians.scales).numpy()
    turns = Rotation.from_quat(splats.quaternions, scalar_first=True).as_matrix()
    expected = turns @ scales @ scales @ turns.transpose(0, 2, 1)
    assert handle.covariances * UNIT**2 == pytest.approx(expected, abs=ROUNDING * np.abs(expected).max())
    assert handle.rgbs / 255 == pytest.approx(np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1), abs=1 / 255)


def test_frames_are_shown_in_any_order_hidden_splats_cost_nothing_and_many_are_sampled(scenario, server, monkeypatch):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    x = run.trajectory.positions
    layer = SplatLayer(server.scene, "order", splats, x[0])
    before = layer.handle.centers.copy()
    layer.move(x[5])
    assert np.array_equal(layer.handle.centers, before)
    layer.show(True)
    for frame in (5, 2, 7, 5):
        layer.move(x[frame])
    again = SplatLayer(server.scene, "order again", splats, x[0])
    again.show(True)
    again.move(x[5])
    assert np.array_equal(layer.handle.centers, again.handle.centers)
    assert (layer.handle.centers != before).any()
    monkeypatch.setattr("neuspring.play.layers.MOST_SPLATS", 100)
    assert len(SplatLayer(server.scene, "many", splats, x[0]).handle.centers) == 100


def test_a_model_with_splats_of_its_own_moves_them_itself(scenario, server):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    positions = splats.means[None] + np.arange(8)[:, None, None] * np.array([0.01, 0, 0])
    layer = SplatLayer(server.scene, "own", splats, run.trajectory.positions[0], SplatCenters(positions=positions))
    assert np.array_equal(layer.carried(run.trajectory.positions[3], 3)[0], positions[3].astype(np.float32))
