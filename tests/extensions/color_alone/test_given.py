"""Controllers, nodes and annotated points of a capture with video of color only and with depth."""

import numpy as np
import torch

from neuspring.config import Config, ScenarioRow
from neuspring.config.perception import Lift, Perception, Sampling
from neuspring.core.provenance import image_stamps
from neuspring.data.capture import CAPTURE, TRACKS, write_tracks
from neuspring.data.results import Masks, PixelTracks
from neuspring.extensions.color_alone.given import GivenFrame, facing
from neuspring.extensions.color_alone.hands import hands_strip
from neuspring.extensions.color_alone.lift import lift
from neuspring.intake.points import Hands, write
from neuspring.perception.lift import lift_tracks
from neuspring.perception.sample import among, assemble, spacing
from neuspring.perception.shape import no_prior
from neuspring.perception.track_opencv import choose
from neuspring.scenes.shapes import sphere
from neuspring.scores import metrics
from neuspring.twin.losses import FrameLoss
from tests.support import small
from tests.support.colored import UP, camera, paint
from tests.support.spaced import describe_as
from tests.support.still import still

ROW = ScenarioRow(scenario="painted", source="capture", category="cloth", path="painted", self_collision=False, ground=True)
SETTINGS = Perception(sample=Sampling(voxel=0.02, nodes=60))
NODES = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-0.1, 0.1, 9), [0.001], indexing="ij"), -1).reshape(-1, 3)
"""Nodes of the painted cloth, 25 mm apart."""
GRIP = np.array([[-0.01, 0.1, 0.004], [0.01, 0.1, 0.004], [0.0, 0.11, 0.01]])
MARKED = np.array([[-0.05, -0.05, 0.0], [0.05, 0.0, 0.0], [0.0, 0.05, 0.0], [0.05, 0.05, 0.0]])


def brought(capture, nodes=NODES[:0], *, train=False):
    """The capture with a hand that rises, with nodes, and with annotated points; point 3 is not seen in frame 0."""
    frames = capture.frame_count
    rise = np.arange(frames)[:, None, None] * np.array([0, 0, 0.004])
    holds = np.ones((frames, len(GRIP)), bool)
    holds[-1, 2] = False
    write(capture.folder, Hands(GRIP + rise, holds, np.array([0, 0, 1])), nodes)
    tracks = MARKED + 0.5 * rise
    tracks[0, 3] = np.nan
    write_tracks(capture.folder, tracks)
    return describe_as(capture, tracks="train" if train else "score"), GRIP + rise, tracks


def seen_of(capture):
    """Observations and what was lifted; the painted points stand still in the image."""
    labels = np.stack([capture.mask("0", frame) for frame in range(capture.frame_count)])
    still = np.repeat(choose(labels[0], 200)[None], capture.frame_count, axis=0)
    tracks = PixelTracks(pixels=still, visible=np.ones(still.shape[:2], bool), backend="test")
    known = lift(capture, {"0": Masks(labels=labels, backend="given")}, {"0": tracks}, SETTINGS)
    return assemble(ROW, capture, known.tracks, known.prior, SETTINGS, known.image), known.tracks


def test_given_hands_are_the_controllers(tmp_path):
    capture, hands, tracks = brought(paint(tmp_path / "painted"))
    seen, lifted = seen_of(capture)
    np.testing.assert_allclose(seen.controller_points, hands, atol=1e-6)
    np.testing.assert_array_equal(seen.controller_hand, [0, 0, 1])
    assert np.argwhere(~seen.controller_valid).tolist() == [[len(hands) - 1, 2]]
    assert seen.image.hands == 0
    assert len(seen.image.hand_of) == 0
    # Points for scoring alone teach nothing.
    assert not seen.object_visibility[1:].any()
    np.testing.assert_allclose(seen.tracks, tracks, atol=1e-6)
    assert np.isfinite(metrics.errors_per_frame(np.repeat(seen.nodes[None], 8, axis=0), seen)["track_error"]).all()
    begun = small.search_problem(seen).recordings[0].hands
    np.testing.assert_allclose(begun[:, :, :3], hands[: seen.scenario.train_end], atol=1e-6)
    strip = hands_strip(capture, seen.image, lifted.controller_points)
    assert (strip == (255, 60, 60)).all(axis=2).any()
    assert {"controllers.npz"} <= seen.scenario.provenance.keys()


def test_given_nodes_and_annotated_points_are_those_of_the_twin(tmp_path):
    capture, _, tracks = brought(paint(tmp_path / "painted"), NODES, train=True)
    seen, lifted = seen_of(capture)
    end = seen.scenario.train_end
    # Annotated points that are seen in frame 0 come first, are seen in training frames, and nowhere in the image.
    np.testing.assert_allclose(seen.object_points[:end, :3], tracks[:end, :3], atol=1e-6)
    assert seen.object_visibility[:end, :3].all()
    assert not seen.object_visibility[end:].any()
    assert seen.object_motion_valid[: end - 1, :3].all()
    assert not seen.object_motion_valid[end - 1 :].any()
    assert not seen.image.visible[:, :3].any()
    assert seen.image.visible[:, 3:].any(axis=0).mean() > 0.5
    # Tracked points lie on the given nodes' surface; each takes the place of a node beside it.
    tracked = seen.object_points[0, 3:]
    assert len(tracked) > 20
    np.testing.assert_allclose(tracked[:, 2], 0.001, atol=0.003)
    given = {tuple(row) for row in NODES.astype(np.float32).round(5).tolist()}
    assert all(tuple(row) in given for row in seen.surface_points.round(5).tolist())
    assert abs(len(tracked) + len(seen.surface_points) - len(NODES)) < 0.35 * len(NODES)
    assert not len(seen.interior_points)
    terms = FrameLoss.of(seen, Config().losses, "cpu").terms(2, torch.tensor(seen.nodes))
    assert all(float(terms[name]) > 0 for name in ("track", "chamfer", "image_track"))
    # Annotated points rise by half of what the hand rises, and nodes are frozen: the nearest is no farther than their own.
    assert 0 < float(terms["chamfer"]) <= 0.004**2
    assert "given nodes" in lifted.backend
    assert seen.scenario.provenance["shape prior"] == "given nodes"


def test_hands_and_nodes_beside_depth_take_the_place_of_what_is_chosen_and_supposed(tmp_path):
    ball = sphere((0, 0, 0.05), 0.05)
    around = ((-0.07, -0.07, -0.01), (0.07, 0.07, 0.12))
    capture, masks, *_ = still(tmp_path / "film", ball, around, [(0.4, -0.3, 0.3)], (0, 0, 0.05))
    rise = np.arange(capture.frame_count)[:, None, None] * np.array([0.004, 0.002, 0.006])
    hands = np.array([[-0.02, 0.0, 0.11], [-0.01, 0.01, 0.115]]) + rise
    grid = np.stack(np.meshgrid(*[np.arange(-0.04, 0.05, 0.02)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.05 * UP
    nodes = grid[np.linalg.norm(grid - 0.05 * UP, axis=1) < 0.045]
    write(capture.folder, Hands(hands, np.zeros((0, 0), bool), np.zeros(0, int)), nodes)
    places = np.repeat(choose(masks["0"].labels[0], 100)[None], capture.frame_count, axis=0)
    tracks = PixelTracks(pixels=places, visible=np.ones(places.shape[:2], bool), backend="test")
    lifted = lift_tracks(capture, masks, {"0": tracks}, Lift(neighborhood=0.02))
    np.testing.assert_allclose(lifted.controller_points, hands, atol=1e-6)
    assert not lifted.controller_valid.size
    assert lifted.facts["controllers"] == 2
    seen = assemble(ROW, capture, lifted, no_prior(), SETTINGS)
    # Tracks keep their measured places on the ball, and given nodes fill the rest of it.
    np.testing.assert_allclose(np.linalg.norm(seen.object_points[0] - 0.05 * UP, axis=1), 0.05, atol=0.004)
    assert len(seen.object_points[0]) > 10
    assert 0.8 * len(nodes) <= len(seen.surface_points) <= len(nodes)


def test_changed_hands_make_perception_run_again_and_changed_points_only_where_they_teach(tmp_path):
    capture, *_ = brought(paint(tmp_path / "painted", frames=5))
    stamp = image_stamps(capture.folder)
    (capture.folder / TRACKS).write_text("[]")
    assert image_stamps(capture.folder) == stamp
    write(capture.folder, None, NODES)
    assert image_stamps(capture.folder) != stamp
    describe_as(capture, tracks="train")
    stamp = image_stamps(capture.folder)
    (capture.folder / TRACKS).write_text("[[]]")
    assert image_stamps(capture.folder) != stamp
    assert (capture.folder / CAPTURE).exists()


def test_hidden_nodes_say_nothing_of_depth():
    view = camera(np.zeros(3), elevation=89.9)
    above, below = NODES + 0.06 * UP, NODES
    front = facing(view, np.concatenate([above, below]))
    np.testing.assert_allclose(np.sort(front[:, 2]), np.sort(view.project(above)[1]), atol=1e-9)
    # What lies behind the camera neither.
    assert len(facing(view, np.concatenate([above, above + 2.0 * UP]))) == len(above)


def test_a_pixel_between_nodes_is_as_deep_as_they_are():
    view = camera(np.zeros(3), elevation=40.0)
    slope = NODES * [1, 1, 0] + NODES[:, :1] * [0, 0, 0.5] + 0.08 * UP
    nothing = {"filled": np.zeros((1, 1), bool), "heights": np.zeros((1, 1)), "lower": np.zeros((1, 1)), "facts": {}}
    known = {"front": facing(view, slope), "apart": spacing(slope), "pixel_size": 0.004}
    frame = GivenFrame(camera=view, up=1.0, kind="given nodes", **nothing, **known)
    places = np.random.default_rng(0).uniform(-0.08, 0.08, (40, 2))
    exact = np.column_stack([places, 0.5 * places[:, 0] + 0.08])
    found = frame.points(view.project(exact)[0])
    # Between nodes 25 mm apart the depth is a mean over nodes around.
    assert np.linalg.norm(found - exact, axis=1).max() < 0.25 * 0.025
    deeper = view.project(frame.fingers(view.project(exact)[0]))[1] - view.project(found)[1]
    np.testing.assert_allclose(deeper, 0.5 * spacing(slope))


def test_points_and_the_nodes_that_stay_are_as_dense_as_the_nodes():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (400, 2)), np.full(400, 0.001)])
    rank = rng.permutation(400)
    chosen, stays = among(points, rank, NODES)
    assert rank[chosen[0]] == 399
    gaps = np.linalg.norm(points[chosen][:, None] - points[chosen], axis=2) + np.eye(len(chosen))
    assert gaps.min() >= spacing(NODES)
    assert np.linalg.norm(points[chosen][:, None] - NODES[stays], axis=2).min() >= 0.5 * spacing(NODES)
    assert abs(len(chosen) + stays.sum() - len(NODES)) < 0.35 * len(NODES)
    nothing, all_stay = among(points[:0], rank[:0], NODES)
    assert not len(nothing)
    assert all_stay.all()
