"""The page without a browser: live twins begin and end, runs with missing parts, and splats that follow the nodes."""

import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

import json
import time
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import SplatCenters
from neuspring.core.files import read_npz, write_npz
from neuspring.data.capture import Capture
from neuspring.extensions.play.layers import NOT_SEEN_COLOR, SPLAT_UNIT, SplatLayer, unseen
from neuspring.extensions.play.page import Page
from neuspring.extensions.play.player import Player
from neuspring.report.shown import find
from neuspring.splats.model import Gaussians
from neuspring.splats.view import C0
from tests.support.captures import describe, entry
from tests.support.played import dressed, record, spoil

RUN = "baseline/0"


@pytest.fixture
def opened(server):
    """Makes the page of a scenario's folder."""
    pages = []

    def make(folder):
        pages.append(Page(server, find([folder])))
        return pages[-1]

    yield make
    for page in pages:
        page.close()
        server.scene.reset()
        server.gui.reset()


def until(what):
    end = time.monotonic() + 120
    while not what():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.02)


def test_a_live_twin_shows_its_springs_is_pulled_reset_and_left_by_playing(opened, scenario):
    dressed(scenario)
    page = opened(scenario)
    body = page.player._bodies[RUN]
    assert body.splats.handle.visible and not body.springs.visible
    page.begin(RUN)
    live = page.live
    assert live.body.springs.visible and live.body.hands.visible and not body.root.visible
    assert live.body.springs.colors.any(), "colored by stiffness"
    place = live.simulator.positions[3].copy()
    assert live.grab.take(1, "node", 3, place, place)
    live.grab.pull(1, place + np.array([0.1, 0, 0.1], np.float32))
    until(lambda: live.simulator.positions[3, 0] > place[0] + 0.02)
    assert "node 3 is held" in live.status()
    live.grab.release(1)
    live.reset()
    until(lambda: live.simulator.frame < 5)
    assert not live.message
    page.toggle()
    assert page.live is None and body.root.visible and page.player.clock.playing


def test_time_stands_still_while_nobody_has_the_page_open(opened, scenario):
    page = opened(scenario)
    page.begin(RUN)
    until(lambda: page.live.simulator.frame > 2)
    page.player.watched.clear()
    time.sleep(0.3)
    frame = page.live.simulator.frame
    time.sleep(0.3)
    assert page.live.simulator.frame == frame


@pytest.mark.parametrize(("aspect", "covered"), [(1.6, 0.0), (0.46, 0.45)])
def test_the_first_view_contains_all_runs_and_no_more_room_than_needed(opened, scenario, aspect, covered):
    player, opening = opened(scenario).player, 0.8
    assert len(player.runs) == 2
    up, look_at, position = player.view(opening, aspect, covered)
    far = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(far, up) / np.linalg.norm(np.cross(far, up))
    corners = np.stack(np.meshgrid(*zip(player.low, player.high, strict=True)), axis=-1).reshape(-1, 3)
    points = np.concatenate([corners + player.offset(index) for index in range(2)]) - position
    x, y = (points @ axis / (points @ far) / np.tan(opening / 2) for axis in (right, np.cross(right, far)))
    x /= aspect
    # The lower part of the window is covered.
    assert np.abs(x).max() <= 1 and y.max() <= 1 and y.min() >= 2 * covered - 1
    assert max(np.abs(x).max(), (np.abs(y - covered) / (1 - covered)).max()) > 0.85


def looked_at(scenario, folder, eye):
    """The scenario as a camera at `eye`, m from the body's middle, saw it."""
    found = find([scenario])
    pose = np.vstack([np.column_stack([np.eye(3), found.observations.nodes.mean(axis=0) + eye]), [0, 0, 0, 1]])
    camera = replace(entry("0"), camera_to_world=tuple(map(tuple, pose.tolist())))
    return replace(found, capture=Capture(folder, describe(cameras=(camera,))))


@pytest.mark.parametrize("eye", [(1.0, 0.2, 0.3), (0.0, 0.0, 1.0)])
def test_a_twin_of_one_camera_opens_from_where_that_camera_was(scenario, server, tmp_path, eye):
    player = Player(server.scene, looked_at(scenario, tmp_path, eye))
    _, look_at, position = player.view(0.8)
    back, seen = (position - look_at) / np.linalg.norm(position - look_at), player._eye - 0.5 * (player.low + player.high)
    assert back @ seen / np.linalg.norm(seen) > 0.999
    assert abs(np.array(player.offset(1)) @ back) < 0.75 * np.linalg.norm(player.offset(1)), "side by side"
    server.scene.reset()


def test_splats_that_nobody_saw_are_gray(scenario, server):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    nodes = run.trajectory.positions[0]
    seen = nodes[nodes[:, 0] < np.median(nodes[:, 0])]
    gray = unseen(splats.means, seen)
    assert gray.any() and not gray.all() and not unseen(splats.means, None).any()
    colors = SplatLayer(server.scene, "gray", splats, nodes, seen=seen).handle.rgbs / 255
    assert (np.ptp(colors[gray], axis=1) < 0.01).all() and len(set(NOT_SEEN_COLOR)) == 1
    assert colors[~gray] == pytest.approx(np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1)[~gray], abs=1 / 255)


def test_switches_change_the_scene_and_the_slider_moves_it(opened, scenario):
    dressed(scenario)
    page = opened(scenario)
    body = page.player._bodies[RUN]
    page.parts["springs"].value = True
    page._changed()
    assert body.nodes.visible and body.springs.visible and body.hands.visible and "stiffness Y" in page.legend.content
    nodes, centers = body.nodes.batched_positions.copy(), body.splats.handle.centers.copy()
    page.show(7)
    until(lambda: page.slider.value == 7)
    assert (body.nodes.batched_positions != nodes).any() and (body.splats.handle.centers != centers).any()
    page.boxes[RUN].value = False
    page._changed()
    assert RUN not in page.player._bodies and len(page.player._bodies) == 1


def test_a_run_of_an_older_format_is_shown_as_far_as_it_goes(opened, scenario):
    path = scenario / "baseline" / "0" / "twin.npz"
    arrays, meta = read_npz(path)
    write_npz(path, arrays, json.dumps(meta | {"format": 0}), compress=True)
    record(path.parent)
    page = opened(scenario)
    assert page.parts["splats"].disabled
    assert page.player._bodies[RUN].springs is None and "must be of kind twin" in page.notes.content
    page.begin(RUN)
    assert page.live is None and "must be of kind twin" in page.text.content


def test_names_of_runs_cannot_put_markup_on_the_page(opened, scenario):
    (scenario / "baseline").rename(scenario / "<img src=x onerror=alert(1)>")
    spoil(scenario / "<img src=x onerror=alert(1)>" / "0" / "rollout.json", '"ok"', '"failed"')
    page = opened(scenario)
    assert "&lt;img" in page.notes.content and "<img" not in page.notes.content


def test_what_the_browser_gets_are_their_colors_and_sizes(scenario, server):
    splats, run = dressed(scenario, degree=2), find([scenario]).runs[0]
    handle = SplatLayer(server.scene, "colors", splats, run.trajectory.positions[0]).handle
    assert handle.centers * SPLAT_UNIT == pytest.approx(splats.means, abs=1e-6)
    scales = torch.diag_embed(Gaussians.of(splats).scales).numpy()
    turns = Rotation.from_quat(splats.quaternions, scalar_first=True).as_matrix()
    expected = turns @ scales @ scales @ turns.transpose(0, 2, 1)
    # 2e-3: relative error of 16-bit floats, with a margin.
    assert handle.covariances * SPLAT_UNIT**2 == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())
    assert handle.rgbs / 255 == pytest.approx(np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1), abs=1 / 255)


def test_frames_are_shown_in_any_order_hidden_splats_cost_nothing_and_many_are_sampled(scenario, server, monkeypatch):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    x = run.trajectory.positions
    layer, again = (SplatLayer(server.scene, name, splats, x[0]) for name in ("order", "again"))
    before = layer.handle.centers.copy()
    layer.move(x[5])
    assert np.array_equal(layer.handle.centers, before)
    layer.handle.visible = again.handle.visible = True
    for frame in (5, 2, 7, 5):
        layer.move(x[frame])
    again.move(x[5])
    assert np.array_equal(layer.handle.centers, again.handle.centers)
    assert (layer.handle.centers != before).any()
    monkeypatch.setattr("neuspring.extensions.play.layers.MOST_DRAWN_SPLATS", 100)
    assert len(SplatLayer(server.scene, "many", splats, x[0]).handle.centers) == 100


def test_a_model_with_splats_of_its_own_moves_them_itself(scenario, server):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    positions = splats.means[None] + np.arange(8)[:, None, None] * np.array([0.01, 0, 0])
    layer = SplatLayer(server.scene, "own", splats, run.trajectory.positions[0], SplatCenters(positions=positions))
    assert np.array_equal(layer.carried(run.trajectory.positions[3], 3)[0], positions[3].astype(np.float32))
