"""Hands, nodes and annotated points in space: files are read, captures of points alone become observations, faults are named."""

import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from neuspring.config import Config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.files import read_npz
from neuspring.data.capture import CAPTURE, CONTROLLERS, NODES, REST, TRACKS, Capture, write_tracks
from neuspring.intake.check import check_layout
from neuspring.intake.points import Hands, held, observe, read, standing, write
from neuspring.scenes.sources import SOURCES, scenario_rows
from tests.support import spaced as scene
from tests.support.filmed import film
from tests.support.findings import holds, serious
from tests.support.spaced import spaced

TOLERANCE = 1e-6
"""m: tracks.json has six digits, observations are float32."""


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return spaced(tmp_path_factory.mktemp("captures") / "lifted")


@pytest.fixture
def capture(original, tmp_path):
    """A copy to change."""
    return Capture.load(shutil.copytree(original.folder, tmp_path / "lifted"))


def observed(capture):
    folder, name = capture.folder.parent, capture.folder.name
    (folder / "scenarios.tsv").write_text("scenario\tsource\tcategory\tpath\tself_collision\tground\n")
    settings = Config(data_root=str(folder), scenarios=(name,), scenario_table=str(folder / "scenarios.tsv"))
    return observe(scenario_rows(settings)[name], capture.folder, settings, capture.folder / "observations.npz")


def csv(capture, change=lambda rows: rows, header="frame,point,x,y,z,holds,hand"):
    """Write controllers.csv in place of the npz, its rows in another order."""
    hands = read(capture).hands
    (capture.folder / CONTROLLERS[0]).unlink()
    rows = [
        [t, 10 + c, *hands.points[t, c], int(t > 0 or c != 2), c % 2]
        for c in range(hands.points.shape[1])
        for t in range(len(hands.points))
    ]
    lines = [",".join(map(str, row)) for row in change(rows)]
    (capture.folder / CONTROLLERS[1]).write_text("\n".join([header, *lines]) + "\n")


def test_a_mass_is_kept_and_one_that_is_not_known_is_in_no_file(capture):
    path = capture.folder / CAPTURE
    plain = json.loads(path.read_text())
    observed(capture).save(capture.folder / "observations.npz")
    assert "mass" not in plain and "mass" not in read_npz(capture.folder / "observations.npz")[1]["fields"]["scenario"]
    path.write_text(json.dumps(plain | {"mass": 0.35}))
    observed(capture).save(capture.folder / "observations.npz")
    assert Observations.load(capture.folder / "observations.npz").scenario.mass == 0.35


def test_annotated_points_are_the_first_nodes_and_the_given_nodes_follow(original):
    seen = observed(original)
    assert seen.scenario.source == "points"
    assert (seen.scenario.frame_count, seen.scenario.train_end, seen.scenario.up) == (8, 5, "+z")
    np.testing.assert_allclose(seen.object_points[0], scene.MARKED[:3], atol=TOLERANCE)
    np.testing.assert_allclose(seen.surface_points, scene.NODES, atol=TOLERANCE)
    np.testing.assert_allclose(seen.controller_points, scene.risen(scene.GRIP, 8), atol=TOLERANCE)
    np.testing.assert_array_equal(seen.controller_hand, [0, 1, 0, 1])
    assert not seen.controller_valid.size
    # Point 1 is not annotated in frame 2, so neither of the motions about it counts; the last frame has none.
    np.testing.assert_array_equal(seen.object_visibility[:, 1], [1, 1, 0, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(seen.object_motion_valid[:, 1], [1, 0, 0, 1, 1, 1, 1, 0])
    # Point 3 cannot be a node, which begins in frame 0. It is scored.
    assert seen.tracks.shape == (8, 4, 3)
    assert np.isfinite(seen.tracks[1:, 3]).all()
    assert CONTROLLERS[0] in seen.scenario.provenance


def test_a_node_at_an_annotated_point_is_left_out_and_nodes_below_the_table_are_lifted(capture):
    nodes = scene.NODES.copy()
    nodes[0], nodes[1, 2] = scene.MARKED[0], -0.01
    write(capture.folder, None, nodes)
    seen = observed(capture)
    assert len(seen.surface_points) == len(nodes) - 1
    assert seen.surface_points[:, 2].min() == 0


def test_the_unloaded_shape_follows_the_points_that_stay(capture):
    nodes = scene.NODES.copy()
    nodes[0] = scene.MARKED[0]
    write(capture.folder, None, nodes)
    rest = np.random.default_rng(0).normal(size=(4 + len(nodes) + 4, 3))
    np.savez(capture.folder / REST, points=rest)
    seen = observed(capture)
    # Point 3 is not seen in frame 0, and node 0 lies at point 0.
    np.testing.assert_allclose(seen.rest_shape, np.delete(rest, [3, 4], axis=0), atol=TOLERANCE)
    np.savez(capture.folder / REST, points=rest[1:])
    with pytest.raises(InputError, match=r"rest\.npz.*annotated points, nodes and controllers"):
        read(capture)


def test_up_may_be_minus_z(tmp_path):
    assert serious(check_layout(spaced(tmp_path / "down", up=-1.0).folder)) == []


def test_a_table_of_rows_is_read_as_the_arrays_are(capture):
    before = read(capture)
    csv(capture, lambda rows: rows[::-1])
    hands = read(capture).hands
    np.testing.assert_allclose(hands.points, before.hands.points)
    np.testing.assert_array_equal(hands.hand, before.hands.hand)
    np.testing.assert_array_equal(np.argwhere(~hands.holds), [[0, 2]])


def test_nodes_may_be_the_vertices_of_a_ply_file(capture):
    (capture.folder / NODES[0]).unlink()
    trimesh.PointCloud(scene.NODES).export(capture.folder / NODES[1])
    np.testing.assert_allclose(read(capture).nodes, scene.NODES, atol=TOLERANCE)


def test_a_controller_that_holds_later_begins_where_the_body_was_that_it_will_hold():
    tracks = scene.risen(scene.MARKED, 8)
    tracks[:, 1] += np.arange(8)[:, None] * [0.01, 0, 0]
    points = np.zeros((8, 2, 3))
    points[:, 0] = [9.0, 9.0, 9.0]
    points[3:, 0] = tracks[3, 1] + [0.001, 0, 0]
    holds = np.ones((8, 2), bool)
    holds[:3, 0] = False
    hands = Hands(points, holds, np.zeros(0, int))
    placed = held(hands, tracks, 5)
    np.testing.assert_allclose(placed[0], [tracks[0, 1] + [0.001, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(placed[1:], points[1:])
    # From frame 5 on nothing of the object is read: the motion until frame 4 counts.
    holds[:7, 0] = False
    hands = Hands(points, holds, np.zeros(0, int))
    np.testing.assert_allclose(held(hands, tracks, 5)[0, 0], points[7, 0] - (tracks[4, 1] - tracks[0, 1]))
    changed = np.where(np.arange(8)[:, None, None] < 5, tracks, np.nan)
    np.testing.assert_array_equal(*(held(hands, moved, 5) for moved in (changed, tracks)))


def arrays(path, **changes):
    with np.load(path) as stored:
        values = {name: stored[name] for name in stored.files}
    np.savez(path, **{name: change(values.get(name)) for name, change in ({n: lambda v: v for n in values} | changes).items()})


def controllers(change):
    return lambda folder: arrays(folder / CONTROLLERS[0], points=change)


def nodes(change):
    return lambda folder: arrays(folder / NODES[0], points=change)


def tracks(change):
    return lambda folder: write_tracks(folder, change(Capture.load(folder).tracks()))


def flipped(folder):
    """A byte in the middle of a compressed array is another one."""
    path = folder / CONTROLLERS[0]
    with np.load(path) as stored:
        np.savez_compressed(path, **{name: stored[name] for name in stored.files})
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 255
    path.write_bytes(bytes(data))


def put(place, *index):
    """Points of a file with one of them at a place."""

    def change(points):
        points[index] = place
        return points

    return change


def parked(holds):
    """Controller 2 waits 100 m below, where it holds or not."""
    held = np.ones((8, 4), bool)
    held[0, 2] = holds
    return lambda folder: arrays(folder / CONTROLLERS[0], points=put((0, 0, -100.0), 0, 2), holds=lambda _: held)


def unknown(folder):
    """A coordinate of point 1 in frame 1 is NaN; Python's JSON reads and writes such words."""
    listed = json.loads((folder / TRACKS).read_text())
    listed[1][1][0] = np.nan
    (folder / TRACKS).write_text(json.dumps(listed))


def everything(change):
    return lambda folder: [each(change)(folder) for each in (controllers, nodes, tracks)]


def hanging_with_y_up(points):
    return (points + np.array([0, 0.4, 0.5]))[..., [0, 2, 1]] * [1, 1, -1]


FAULTS = [
    (controllers(lambda p: p[:7]), CONTROLLERS[0], ("8 frames are required", "received 7", "Cut or resample")),
    (controllers(lambda p: p[0]), CONTROLLERS[0], ("[T, C, 3]", "[4, 3]")),
    (controllers(put(np.nan, 3, 1, 2)), CONTROLLERS[0], ("finite", "nan at index [3, 1, 2] (1 in all)")),
    (controllers(lambda p: 1000 * p), CONTROLLERS[0], ("largest coordinate", "divide by 1000 if they are millimeters")),
    (
        controllers(lambda p: p + np.array([0.5, 0, 0])),
        CONTROLLERS[0],
        ("smallest distance between grasping controllers", "at most 0.06 m"),
    ),
    (lambda f: arrays(f / CONTROLLERS[0], holds=lambda _: np.ones((8, 3), bool)), CONTROLLERS[0], ("holds", "[8, 4] bool")),
    (lambda f: arrays(f / CONTROLLERS[0], holds=lambda _: np.zeros((8, 4), bool)), CONTROLLERS[0], ("holds", "some controller")),
    (lambda f: arrays(f / CONTROLLERS[0], grip=lambda _: np.zeros(3)), CONTROLLERS[0], ("optional holds and hand", "grip")),
    (flipped, CONTROLLERS[0], (".npz file",)),
    (
        controllers(put(scene.NODES[7], slice(None), 1)),
        CONTROLLERS[0],
        ("0.1 mm from nodes", "controller 1, 1 in all"),
    ),
    (parked(True), CONTROLLERS[0], ("largest coordinate", "divide by 1000")),
    (lambda f: (f / CONTROLLERS[0]).unlink(), CONTROLLERS[0], ("a capture without cameras needs controllers.npz",)),
    (nodes(lambda p: 10000 * p), NODES[0], ("largest coordinate", "divide by 10000 if they are tenths of a millimeter")),
    (nodes(lambda p: np.concatenate([p, p[:2]])), NODES[0], ("0.1 mm apart", "2 pairs", "Remove duplicate nodes")),
    (nodes(lambda p: p[:2]), NODES[0], ("at least 3 nodes", "received 2")),
    (nodes(lambda p: p * np.array([1, 1, -8.0])), NODES[0], ("z from -0.16 to 0 m", "pass --up -z")),
    (nodes(lambda p: p + np.array([1.0, 0, 0])), TRACKS, ("largest distance between annotated points", "3 of 3", "same recording")),
    (tracks(lambda p: p[:, :2]), TRACKS, ("at least 3 points", "2 of 2")),
    (unknown, TRACKS, ("coordinates must be finite", "point 1, frame 1", "null")),
    (lambda f: (f / TRACKS).unlink(), TRACKS, ("at least 3 points", "0 of 0")),
    (tracks(put(9999.0, slice(3, 5), 2)), TRACKS, ("point 2 from frame 3", "Write null")),
    (controllers(put(0.0, slice(3, 5))), CONTROLLERS[0], ("point 0 from frame 3", "`holds`")),
    (everything(hanging_with_y_up), NODES[0], ("points move most along y", "(x, -z, y)")),
]


@pytest.mark.parametrize(("damage", "file", "words"), FAULTS, ids=[f"{k}-{f[1]}" for k, f in enumerate(FAULTS)])
def test_faults_are_named_before_any_cost(capture, damage, file, words):
    damage(capture.folder)
    found = check_layout(capture.folder)
    assert holds(found, "error", file, *words), found
    # The workflow refuses it before its first job.
    with pytest.raises(InputError, match=re.escape(file)):
        SOURCES["points"].required(capture.folder)


@pytest.mark.parametrize(
    ("change", "header", "words"),
    [
        (lambda rows: rows, "frame,point,x,y,z,holds,side", r"header must be frame,point,x,y,z.*side"),
        (lambda rows: rows[1:], None, r"each point needs one row per frame.*31 rows, 8 frames up to 7, 4 points"),
        (lambda rows: [[row[0] + 1, *row[1:]] for row in rows], None, r"frames must be 0, 1, 2.*8 frames up to 8"),
        (lambda rows: [[*row[:5], "yes", row[6]] for row in rows], None, r"holds: every entry must be a number"),
        (lambda rows: [[*row[:5], 2, row[6]] for row in rows], None, r"holds: must be 0 or 1"),
        (lambda rows: [[*row[:6], k] for k, row in enumerate(rows)], None, r"hand: must be one integer for each point"),
        (lambda rows: [*rows, list(range(9))], None, r"rows of numbers with one header line"),
    ],
)
def test_rows_of_another_form_are_refused(capture, change, header, words):
    csv(capture, change, *([header] if header else []))
    with pytest.raises(InputError, match=rf"controllers\.csv.*{words}"):
        read(capture)


def test_what_is_no_place_is_said_once(capture):
    tracks(put(9999.0, slice(3, 5), 2))(capture.folder)
    assert [one.name for one in check_layout(capture.folder)] == ["lost points as numbers"]


def test_a_hand_may_be_anywhere_while_it_holds_nothing(capture):
    parked(False)(capture.folder)
    assert serious(check_layout(capture.folder)) == []


def test_a_hand_must_hold_in_some_training_frame(capture):
    late = np.zeros((8, 4), bool)
    late[6:] = True
    arrays(capture.folder / CONTROLLERS[0], holds=lambda _: late)
    assert holds(check_layout(capture.folder), "error", CONTROLLERS[0], "hold the object in a training frame")


def test_nodes_that_meet_on_the_table_are_one():
    nodes = np.array([[0.0, 0, -0.02], [0, 0, -0.01], [0, 0, 0.01], [0.02, 0, -0.01]])
    np.testing.assert_allclose(standing(nodes, 1.0)[0], [[0, 0, 0], [0, 0, 0.01], [0.02, 0, 0]])


def test_a_film_and_points_alone_are_not_taken_for_each_other(capture, tmp_path):
    with pytest.raises(InputError, match=r"the source capture requires video.*source to points"):
        SOURCES["capture"].required(capture.folder)
    filmed = film(tmp_path / "film", cameras=1)
    with pytest.raises(InputError, match=r"the source points is only for captures without cameras.*source to capture"):
        SOURCES["points"].required(filmed.folder)


def test_two_files_of_hands_are_refused(capture):
    (capture.folder / CONTROLLERS[1]).write_text("frame,point,x,y,z\n")
    with pytest.raises(InputError, match=r"one of controllers\.npz and controllers\.csv.*Remove one"):
        read(capture)


def test_a_capture_without_cameras_says_what_it_is(capture):
    path = capture.folder / CAPTURE
    path.write_text(json.dumps({name: value for name, value in json.loads(path.read_text()).items() if name != "tracks"}))
    with pytest.raises(InputError, match=r"cameras: at least one is required.*tracks is train.*received none"):
        Capture.load(capture.folder)


def posed(frames=8):
    """Poses [T, 2, 4, 4] of two hands that rise by 5 mm and turn by 0.1 rad a frame, and two jaws each."""
    poses = np.tile(np.eye(4), (frames, 2, 1, 1))
    poses[:, 1, :3, :3] = Rotation.from_euler("z", 0.1 * np.arange(frames)[:, None]).as_matrix()
    poses[..., :3, 3] = [[0, 0, 0.03], [0, 0.06, 0.03]] + 0.005 * np.arange(frames)[:, None, None] * np.array([0, 0, 1.0])
    return poses, np.array([[0.0, 0, 0], [0.02, 0, 0.01]])


def of_poses(capture, **arrays):
    (capture.folder / CONTROLLERS[0]).unlink()
    np.savez(capture.folder / CONTROLLERS[0], **arrays)
    return Capture.load(capture.folder)


def test_hands_with_a_pose_carry_their_jaws(capture):
    poses, jaws = posed()
    hands = read(of_poses(capture, poses=poses, jaws=jaws)).hands
    wanted = np.einsum("thij,cj->thci", poses[..., :3, :3], jaws) + poses[:, :, None, :3, 3]
    np.testing.assert_allclose(hands.points, wanted.reshape(8, 4, 3), atol=1e-12)
    np.testing.assert_array_equal(hands.hand, [0, 0, 1, 1])
    # Points of a hand keep their distances.
    np.testing.assert_allclose(np.linalg.norm(hands.points[:, 3] - hands.points[:, 2], axis=1), np.hypot(0.02, 0.01), atol=1e-12)
    seen = observed(capture)
    assert seen.controller_points.shape == (8, 4, 3) and not seen.controller_valid.size


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda poses: {"poses": poses[..., :3, :]}, r"poses: finite numbers \[T, 4, 4\]"),
        (lambda poses: {"poses": poses * [1, -1, 1, 1]}, r"rotation.*frame 0, hand 0.*right-handed"),
        (lambda poses: {"poses": np.swapaxes(poses, -1, -2)}, r"last row 0, 0, 0, 1"),
        (lambda poses: {"poses": poses, "jaws": np.zeros((3, 4, 3))}, r"jaws: finite numbers.*frame, m"),
        (lambda poses: {"poses": poses, "hand": np.zeros(4, int)}, r"poses, optional jaws and holds"),
        (lambda poses: {"poses": poses[:5]}, r"8 frames are required"),
    ],
)
def test_poses_that_are_none_are_named(capture, change, message):
    with pytest.raises(InputError, match=message):
        read(of_poses(capture, **change(posed()[0])))
