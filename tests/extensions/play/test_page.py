"""What the page does without a browser: live twins begin and end, tracks, runs that lack something, another format, and splats
that follow the nodes, in whatever order frames are shown."""

import pytest

pytest.importorskip("viser", reason="the extra [play] is not installed")

import json
import time
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuspring.cli.main import main
from neuspring.core.artifacts import SplatCenters, Trajectory
from neuspring.core.files import read_npz, write_npz
from neuspring.core.records import digest_file
from neuspring.data.capture import Capture
from neuspring.extensions.play.colors import linear
from neuspring.extensions.play.layers import NOT_SEEN_COLOR, SPLAT_UNIT, SplatLayer, unseen
from neuspring.extensions.play.page import Page
from neuspring.extensions.play.player import Player
from neuspring.report.shown import find
from neuspring.scores.metrics import track_errors
from neuspring.splats.model import Gaussians
from neuspring.splats.view import C0
from tests.extensions.rods.ropes import rod_results
from tests.support.captures import describe, entry
from tests.support.played import dressed, record, softer, spoil

RUN = "baseline/0"


@pytest.fixture
def opened(server, tmp_path):
    """Makes the page of a scenario's folder."""
    pages = []

    def make(folder):
        pages.append(Page(server, find([folder]), tmp_path / "saved"))
        return pages[-1]

    yield make
    for page in pages:
        page.close()
        server.scene.reset()
        server.gui.reset()


def until(what) -> None:
    end = time.monotonic() + 120
    while not what():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.02)


def test_a_live_twin_is_shown_by_strain_and_the_recording_as_before(opened, scenario):
    dressed(scenario)
    page = opened(scenario)
    page.parts["springs"].value = True
    assert not page.parts["hands"].value
    page.panel.start(RUN)
    assert page.quantity.value == "strain" and "-0.3" in page.legend.content
    until(lambda: page.panel.live.body.hands.visible)
    assert page.panel.switch.label == "Back to the recording"
    page.panel.most.value = 0.5
    page.panel._limit()
    assert "-0.5" in page.legend.content
    page.panel.stop()
    assert page.quantity.value == "stiffness" and "stiffness Y" in page.legend.content
    until(lambda: not page.player._bodies[RUN].hands.visible)


def test_a_rod_is_shown_and_pulled_live(opened, tmp_path):
    page = opened(rod_results(tmp_path))
    page.panel.start("rod/0")
    live = page.panel.live
    edges = len(live.simulator.twin.body.lengths)
    assert len(live.body.parts.pairs) == edges + len(live.simulator.twin.topology.springs)
    until(lambda: live.simulator.frame > 2)
    place = live.simulator.positions[4].copy()
    assert live.grab.take(1, "node", 4, place, place)
    live.grab.pull(1, place + np.array([0, 0.03, 0.0]))
    until(lambda: live.simulator.positions[4, 1] > place[1] + 0.01)
    live.grab.release(1)
    until(lambda: live.simulator.grabbed == -1)
    assert not live.message
    assert live.strain < 0.3


@pytest.mark.parametrize("action", [lambda page: page.toggle(), lambda page: page.show(3)])
def test_playing_and_stepping_lead_back_from_a_live_twin(opened, scenario, action):
    page = opened(scenario)
    page.panel.start(RUN)
    action(page)
    assert page.panel.live is None and page.player._bodies[RUN].root.visible


def test_time_stands_still_while_nobody_has_the_page_open(opened, scenario):
    page = opened(scenario)
    page.panel.start(RUN)
    live = page.panel.live
    until(lambda: live.simulator.frame > 2)
    page._left()
    time.sleep(0.3)
    frame = live.simulator.frame
    time.sleep(0.3)
    assert live.simulator.frame == frame
    page.player.watched.set()
    until(lambda: live.simulator.frame > frame)
    page.toggle()
    page._left()
    time.sleep(0.1)
    before = page.player.clock.time
    time.sleep(0.2)
    assert page.player.clock.time == before and page.player.clock.playing


@pytest.mark.parametrize(("aspect", "covered"), [(1.6, 0.0), (0.46, 0.45)])
def test_the_first_view_holds_all_runs_and_no_more_room_than_needed(opened, scenario, aspect, covered):
    player, opening = opened(scenario).player, 0.8
    assert len(player.display.runs) == 2
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


def looked_at(scenario, folder, *eyes: tuple[float, float, float]):
    """The scenario as cameras at `eyes`, m from the body's middle, saw it."""
    found = find([scenario])
    middle = found.observations.nodes.mean(axis=0)
    poses = [np.vstack([np.column_stack([np.eye(3), middle + eye]), [0, 0, 0, 1]]) for eye in eyes]
    cameras = tuple(replace(entry(str(k)), camera_to_world=tuple(map(tuple, pose.tolist()))) for k, pose in enumerate(poses))
    return replace(found, capture=Capture(folder, describe(cameras=cameras)))


@pytest.mark.parametrize("eye", [(1.0, 0.2, 0.3), (0.1, -1.0, 0.4), (0.0, 0.0, 1.0)])
def test_a_twin_of_one_camera_opens_from_where_that_camera_stood(scenario, server, tmp_path, eye):
    player = Player(server.scene, looked_at(scenario, tmp_path, eye))
    _, look_at, position = player.view(0.8)
    back = (position - look_at) / np.linalg.norm(position - look_at)
    player.display.runs = player.display.runs[:1]
    _, look_at, position = player.view(0.8)
    middle = 0.5 * (player.low + player.high)
    seen = player._eye - middle
    assert back @ seen / np.linalg.norm(seen) > 0.999
    # With one run, its middle is what is looked at.
    assert look_at == pytest.approx(middle)
    # Runs stand beside each other, and not one behind the other.
    assert abs(np.array(player.offset(1)) @ back) < 0.75 * np.linalg.norm(player.offset(1))
    server.scene.reset()


def test_several_cameras_leave_the_view_as_it_was(scenario, server, tmp_path):
    plain, rig = Player(server.scene, find([scenario])), Player(server.scene, looked_at(scenario, tmp_path, (1, 0, 0), (0, 1, 0)))
    assert all(np.array_equal(a, b) for a, b in zip(plain.view(0.8), rig.view(0.8), strict=True))
    server.scene.reset()


def test_parts_that_nobody_saw_are_gray(scenario, server, tmp_path):
    splats, found = dressed(scenario), looked_at(scenario, tmp_path, (1.0, 0.2, 0.3))
    nodes = found.observations.nodes
    seen = nodes[nodes[:, 0] < np.median(nodes[:, 0])]
    assert not unseen(nodes, None).any()
    assert not unseen(seen, seen).any()
    hidden = unseen(nodes, seen)
    assert hidden[nodes[:, 0] > nodes[:, 0].max() - 0.01].all()
    half = replace(found.observations, **half_seen(found.observations, hidden))
    player = Player(server.scene, replace(found, observations=half))
    body = player._bodies["baseline/0"]
    assert (body.nodes.batched_colors[unseen(nodes, player.seen)] == linear(np.array(NOT_SEEN_COLOR, np.uint8))).all()
    assert (body.nodes.batched_colors[~unseen(nodes, player.seen)] != linear(np.array(NOT_SEEN_COLOR, np.uint8))).any(axis=1).all()
    colors, gray = body.splats.handle.rgbs / 255, unseen(splats.means, player.seen)
    assert gray.any() and not gray.all()
    assert (np.ptp(colors[gray], axis=1) < 0.01).all()
    own = np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1)
    assert colors[~gray] == pytest.approx(own[~gray], abs=1 / 255)
    server.scene.reset()


def half_seen(observations, hidden: np.ndarray) -> dict[str, np.ndarray]:
    """Fields of observations whose `hidden` nodes [N] bool were never tracked: they are further nodes of the surface."""
    count = observations.object_points.shape[1]
    tracked = ~hidden[:count]
    kept = {name: getattr(observations, name)[:, tracked] for name in ("object_points", "object_visibility", "object_motion_valid")}
    return kept | {"surface_points": np.concatenate([observations.object_points[0][~tracked], observations.surface_points])}


def test_a_stretch_above_the_limit_is_red_and_said(opened, scenario):
    page = opened(scenario)
    page.panel.most.value = 0.05
    page.panel.start(RUN)
    live = page.panel.live
    assert "below 0.05" in live.status() or live.over
    place = live.simulator.positions[3]
    live.grab.take(1, "node", 3, place)
    live.grab.pull(1, place + np.array([0.2, 0, 0.2], np.float32))
    until(lambda: live.over > 0)
    assert "Over-stretched" in live.status() and "above 0.05" in live.status()
    assert (live.body.springs.colors[:, 0] == [255, 0, 0]).all(axis=1).any()


def test_hands_repeat_the_recording_from_a_frame_and_cannot_be_taken(opened, scenario):
    page = opened(scenario)
    page.panel.frame.value, page.panel.repeat.value = 2, True
    page.panel.start(RUN)
    live = page.panel.live
    assert not live.grab.take(1, "hand", 0, (0, 0, 0))
    until(lambda: live.simulator.frame >= 7)
    assert "the recorded hands have ended" in live.status()
    assert np.array_equal(live.simulator.hands, page.found.observations.controller_points[-1])
    page.panel._save()
    until(lambda: "saved" in live.message)
    assert len(list((scenario.parent / "saved").glob("controls_small_baseline_0_0.npz"))) == 1


def test_the_track_error_in_a_frame_is_that_of_the_scores(opened, scenario):
    page = opened(scenario)
    page.show(5)
    until(lambda: page.player.clock.frame == 5 and not page._moved)
    until(lambda: page.player._bodies[RUN].overlay.error is not None)
    run, seen = page.player.run(RUN), page.found.observations
    expected = track_errors(run.trajectory.positions, seen.tracks)[5]
    with page.player.lock:
        page.player.draw()
        assert page.player._bodies[RUN].overlay.error == pytest.approx(expected, rel=1e-5)
    assert f"{RUN} {1e3 * expected:.1f} mm" in page.player.errors()


def test_splats_come_first_and_nodes_springs_and_hands_at_a_switch(opened, scenario):
    dressed(scenario)
    page = opened(scenario)
    body = page.player._bodies[RUN]
    parts = (body.nodes, body.springs, body.hands)
    assert body.splats.shown and not any(part.visible for part in parts) and not page.legend.content
    for name in ("nodes", "springs", "hands"):
        page.parts[name].value = True
    page._changed()
    assert all(part.visible for part in parts) and "stiffness Y" in page.legend.content
    before = body.splats.handle.centers.copy()
    page.player.clock.show(7)
    page.player.draw()
    assert (body.splats.handle.centers != before).any()


def test_switches_change_the_scene(opened, scenario):
    page = opened(scenario)
    body = page.player._bodies[RUN]
    page.parts["nodes"].value = False
    page._changed()
    assert not body.nodes.visible
    before = body.springs.colors.copy()
    page.quantity.value = "strain"
    page._changed()
    assert (body.springs.colors != before).any() and "strain" in page.legend.content
    page.boxes[RUN].value = False
    page._changed()
    assert RUN not in page.player._bodies


def test_a_saved_recording_is_compared_and_names_its_twin(opened, scenario, capsys):
    page = opened(scenario)
    page.panel.start(RUN)
    live = page.panel.live
    live.grab.take(1, "node", 3, live.simulator.positions[3])
    live.grab.pull(1, live.simulator.positions[3] + [0.1, 0, 0])
    until(lambda: live.simulator.frame >= 6)
    live.grab.release(1)
    page.panel._save()
    page.panel.stop()
    replayed = ["--replay", str(next(page.panel._save_to.glob("controls_small_baseline_0_0.npz"))), "--compare"]
    assert main(["play", str(scenario), *replayed]) == 0
    said = capsys.readouterr().out
    assert "recorded with baseline/0" in said and "neuspring/0" in said
    assert json.dumps(str(scenario)) not in said
    softer(page.player.run(RUN).twin, 0.9).save(scenario / "baseline" / "0" / "twin.npz")
    assert main(["play", str(scenario), *replayed]) == 2
    assert "must be among the runs" in capsys.readouterr().err


def test_what_is_not_there_cannot_be_switched_on(opened, scenario):
    page = opened(scenario)
    assert {name for name, box in page.parts.items() if box.disabled} == {"splats", "cameras", "images"}


def test_a_run_of_an_older_format_is_shown_as_far_as_it_goes(opened, scenario):
    path = scenario / "baseline" / "0" / "twin.npz"
    arrays, meta = read_npz(path)
    write_npz(path, arrays, json.dumps(meta | {"format": 0}), compress=True)
    record(path.parent)
    page = opened(scenario)
    assert page.player._bodies[RUN].springs is None and "this version reads format" in page.notes.content
    page.panel.start(RUN)
    assert page.panel.live is None and "this version reads format" in page.panel.text.content


def test_a_prediction_with_other_nodes_than_its_twin_has_no_springs(opened, scenario):
    place = scenario / "baseline" / "0"
    path, old = place / "trajectory.npz", digest_file(place / "trajectory.npz")
    x = Trajectory.load(path).positions
    Trajectory(positions=x[:, :5], frame_count=len(x)).save(path)
    spoil(place / "rollout.json", old, digest_file(path))
    page = opened(scenario)
    assert page.player._bodies[RUN].springs is None and "no springs" in page.notes.content


def test_names_of_runs_cannot_put_markup_on_the_page(opened, scenario):
    (scenario / "baseline").rename(scenario / "<img src=x onerror=alert(1)>")
    spoil(scenario / "<img src=x onerror=alert(1)>" / "0" / "rollout.json", '"ok"', '"failed"')
    page = opened(scenario)
    assert "<img" not in page.notes.content and "<img" not in page.errors.content


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


def test_what_the_browser_gets_are_their_colors_and_sizes(scenario, server):
    splats, run = dressed(scenario, degree=2), find([scenario]).runs[0]
    handle = SplatLayer(server.scene, "colors", splats, run.trajectory.positions[0]).handle
    assert handle.centers * SPLAT_UNIT == pytest.approx(splats.means, abs=1e-6)
    scales = torch.diag_embed(Gaussians.of(splats).scales).numpy()
    turns = Rotation.from_quat(splats.quaternions, scalar_first=True).as_matrix()
    expected = turns @ scales @ scales @ turns.transpose(0, 2, 1)
    assert handle.covariances * SPLAT_UNIT**2 == pytest.approx(expected, abs=ROUNDING * np.abs(expected).max())
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
    monkeypatch.setattr("neuspring.extensions.play.layers.MOST_DRAWN_SPLATS", 100)
    assert len(SplatLayer(server.scene, "many", splats, x[0]).handle.centers) == 100


def test_a_model_with_splats_of_its_own_moves_them_itself(scenario, server):
    splats, run = dressed(scenario), find([scenario]).runs[0]
    positions = splats.means[None] + np.arange(8)[:, None, None] * np.array([0.01, 0, 0])
    layer = SplatLayer(server.scene, "own", splats, run.trajectory.positions[0], SplatCenters(positions=positions))
    assert np.array_equal(layer.carried(run.trajectory.positions[3], 3)[0], positions[3].astype(np.float32))
