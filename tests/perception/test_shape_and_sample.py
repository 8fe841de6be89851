"""The visual hull of known bodies, alignment of meshes, and structure points one per voxel."""

from contextlib import nullcontext

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config import ScenarioRow
from neuspring.config.perception import Perception, Sampling, ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS
from neuspring.data.results import Masks, ShapePrior
from neuspring.perception import shape
from neuspring.perception.sample import assemble, inside, on_surface, structure, voxel_for
from neuspring.scenes.shapes import capsule, ellipsoid, smooth_union, sphere
from tests.support.filmed import surface
from tests.support.still import overlap, still, tracked

BODY = smooth_union([sphere((0, 0, 0.06), 0.05), capsule((0, 0, 0.06), (0.1, 0, 0.04), 0.03)], 0.005)
EYES = ((0.45, -0.35, 0.4), (-0.2, 0.55, 0.4), (-0.4, -0.4, 0.45))


def film(folder, cameras, with_hand=False):
    """BODY, and perhaps a ball before the first camera that is a hand."""
    hand = (0.12, -0.1, 0.16) if with_hand else None
    return still(folder, BODY, ((-0.08, -0.08, -0.01), (0.15, 0.08, 0.13)), EYES[:cameras], (0.03, 0, 0.06), hand=hand)


def closed(faces):
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return {tuple(e) for e in directed.tolist()} == {tuple(e[::-1]) for e in directed.tolist()}


def test_the_hull_is_closed_near_the_truth_and_better_with_more_cameras(tmp_path):
    quality = []
    for cameras in (1, 2, 3):
        capture, masks, cloud, truth = film(tmp_path / str(cameras), cameras)
        hull = shape.visual_hull(capture, masks, cloud, ShapePriorSettings())
        quality.append(overlap(hull, truth))
    assert quality[0] < quality[1] < quality[2]
    assert quality[2] > 0.8
    assert closed(hull.faces)
    assert hull.vertices[:, 2].min() > -0.004


def test_a_hand_before_the_object_does_not_carve_it(tmp_path):
    capture, masks, cloud, truth = film(tmp_path, 3, with_hand=True)
    assert (masks["0"].labels == HANDS).any()
    assert overlap(shape.visual_hull(capture, masks, cloud, ShapePriorSettings()), truth) > 0.8


def test_contradicting_views_are_refused(tmp_path):
    capture, masks, cloud, _ = film(tmp_path, 2)
    masks["1"] = Masks(labels=np.roll(masks["1"].labels, 55, axis=2), backend="given")
    with pytest.raises(InputError, match="must be consistent with all cameras"):
        shape.visual_hull(capture, masks, cloud, ShapePriorSettings())


def test_a_mesh_in_any_pose_and_size_finds_its_place_wherever_the_object_lies(tmp_path):
    _, _, cloud, truth = film(tmp_path, 3)
    far = np.array([1.0, 0.5, 0.0])
    other = 7.0 * Rotation.from_rotvec([1.0, 0.4, -2.0]).apply(truth.vertices) + [3.0, -2.0, 1.0]
    placed, rms = shape.place(other, truth.faces, cloud + far)
    assert rms < 0.003
    assert overlap(ShapePrior(vertices=placed - far, faces=truth.faces, backend="mesh"), truth) > 0.9


@pytest.fixture(scope="module")
def toy():
    """A flat animal with arms and legs, 0.3 m long, on the table z = 0: a closed surface."""
    parts = [ellipsoid((0, 0, 0.05), (0.085, 0.06, 0.045)), ellipsoid((0.12, 0, 0.06), (0.05, 0.05, 0.042))]
    for side in (1, -1):
        parts.append(capsule((0.05, 0.045 * side, 0.035), (0.11, 0.125 * side, 0.022), 0.02))
        parts.append(capsule((-0.055, 0.04 * side, 0.032), (-0.12, 0.1 * side, 0.022), 0.021))
    vertices, faces = surface(smooth_union(parts, 0.01), (-0.2, -0.2, -0.02), (0.2, 0.2, 0.13), 0.008)
    return trimesh.Trimesh(vertices, faces)


def test_seams_that_rounding_opened_are_joined(toy, tmp_path):
    soup = trimesh.Trimesh(toy.triangles.reshape(-1, 3), np.arange(3 * len(toy.faces)).reshape(-1, 3), process=False)
    soup.vertices = soup.vertices + 1e-6 * np.random.default_rng(0).normal(size=soup.vertices.shape)
    soup.export(tmp_path / "seams.ply")
    vertices, faces = shape.read_mesh(tmp_path / "seams.ply")
    assert closed(faces) and 0.99 * len(toy.vertices) < len(vertices) <= len(toy.vertices)


def inverted(toy: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(toy.vertices, toy.faces[:, ::-1])


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("draco.glb", lambda toy: b'glTF {"extensionsRequired": ["KHR_draco_mesh_compression"]}', "Unpack it: npx"),
        ("both.ply", lambda toy: trimesh.util.concatenate([toy, inverted(toy)]).export(file_type="ply"), "Export one side"),
        ("open.ply", lambda toy: toy.submesh([np.arange(99)], append=True).export(file_type="ply"), "the surface must be closed"),
        ("points.ply", lambda toy: trimesh.PointCloud(toy.vertices).export(file_type="ply"), "at least one triangle"),
    ],
)
def test_files_without_one_closed_surface_are_refused(toy, tmp_path, name, write, words):
    (tmp_path / name).write_bytes(write(toy))
    with pytest.raises(InputError, match=words):
        shape.read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "start", "fits"),
    [("own", 0, True), ("own", 180, False), ("floor", 0, False), ("ball", 0, False), ("long", 0, False), ("sunk", 0, False)],
)
def test_a_mesh_must_fit_what_was_seen(toy, kind, start, fits):
    """Alone in its pose; upside down; on a floor; beside a ball; with a tail; below the table."""
    rng = np.random.default_rng(0)
    seen = on_surface(toy.vertices, toy.faces[toy.face_normals[:, 2] > 0], shape.COMPARED_SURFACE, rng)
    floor, ball = trimesh.creation.box((0.5, 0.5, 0.01)), trimesh.creation.icosphere(3, 0.06)
    ball.apply_translation((0.37, 0, 0.06))
    mesh = trimesh.util.concatenate([toy, *{"floor": [floor], "ball": [ball]}.get(kind, [])])
    source = on_surface(mesh.vertices, mesh.faces, shape.COMPARED_SURFACE, rng)
    center = source.mean(axis=0)
    turn = Rotation.from_euler("x", start, degrees=True)
    rms, turn, size, shift = shape._icp(source - center, seen, turn, 1.0, seen.mean(axis=0), shape.ITERATIONS)
    placed = size * turn.apply(mesh.vertices - center) + shift
    placed *= [1.5 if kind == "long" else 1.0, 1, 1]
    placed -= [0, 0, 0.05 if kind == "sunk" else 0.0]
    said = nullcontext() if fits else pytest.raises(InputError, match="observed points: RMS distance at most 9 mm")
    with said:
        shape.require_fit("mesh.ply", placed, rms, seen, 1.0)


def test_bending_brings_the_visible_part_to_where_it_was_seen(tmp_path):
    capture, masks, cloud, truth = film(tmp_path, 3)
    bent = truth.vertices + np.array([0, 0, 0.008]) * np.sin(np.pi * (truth.vertices[:, :1] / 0.1))
    result = shape.bend(bent.astype(float), truth.faces, capture, masks, cloud)
    before, after = (np.median(cKDTree(v).query(cloud)[0]) for v in (bent, result))
    assert after < 0.75 * before


def test_inside_is_where_the_distance_is_negative(tmp_path):
    _, _, _, truth = film(tmp_path, 1)
    points = np.random.default_rng(1).uniform((-0.1, -0.1, 0.0), (0.17, 0.1, 0.15), (2000, 3))
    clear = np.abs(BODY(points)) > 0.002
    np.testing.assert_array_equal(inside(truth, points)[clear], (BODY(points) < 0)[clear])


def test_one_point_per_voxel():
    points = np.random.default_rng(0).uniform(0, 0.1, (4000, 3))
    points[0] = 0.0
    indices, _, _, _ = structure(tracked(points), shape.no_prior(), Sampling(voxel=0.02), 1.0, 0)
    cells = np.floor(points[indices] / 0.02).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells) == 125


def test_observed_points_come_before_the_surface_and_it_before_the_inside(tmp_path):
    _, _, cloud, truth = film(tmp_path, 3)
    everything = tracked(cloud[::3])
    indices, outer, inner, _ = structure(everything, truth, Sampling(voxel=0.01), 1.0, 0)
    again, other = (structure(everything, truth, Sampling(voxel=0.01), 1.0, seed)[2] for seed in (0, 1))
    np.testing.assert_array_equal(inner, again)
    assert inner.shape != other.shape or not np.array_equal(inner, other)
    alone, bare, _, _ = structure(tracked(cloud[:1]), truth, Sampling(voxel=0.01), 1.0, 0)
    assert len(indices) > 50
    assert 10 < len(outer) < len(bare)
    assert len(alone) == 1
    assert inside(truth, inner).mean() > 0.98
    assert cKDTree(everything.object_points[0, indices]).query(outer)[0].min() > 1e-4


def test_without_a_prior_only_what_was_seen_remains():
    points = np.array([[0.0, 0, 0.01], [0.0, 0, 0.01], [0.05, 0, -0.01], [0.1, 0, 0.02]])
    indices, outer, inner, _ = structure(tracked(points), shape.no_prior(), Sampling(), 1.0, 0)
    assert indices.tolist() == [0, 2, 3]
    assert not len(outer)
    assert not len(inner)


def line_and_ball():
    """A rope of 0.6 m and a ball of 8 cm, 3000 points each."""
    rng = np.random.default_rng(3)
    rope = rng.uniform([0, 0, 0.1], [0.6, 0.01, 0.11], (3000, 3))
    ball = rng.normal(size=(3000, 3))
    return rope, 0.08 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + np.array([0, 0, 0.2])


def test_more_nodes_never_make_a_coarser_spacing_and_are_never_exceeded():
    for points in line_and_ball():
        before = np.inf
        for most in (37, 38, 39, 300, 3000, 10**6):
            voxel = voxel_for(points, most, 0.002)
            kept, _, _, used = structure(tracked(points), shape.no_prior(), Sampling(voxel=0.002, nodes=most), 1.0, 0)
            assert 0.002 <= voxel <= before
            assert len(kept) <= most
            assert used == pytest.approx(voxel, rel=1e-5)
            before = voxel
        plain, _, _, side = structure(tracked(points), shape.no_prior(), Sampling(voxel=0.002), 1.0, 0)
        assert side == voxel == 0.002
        np.testing.assert_array_equal(plain, kept)


def test_a_rope_is_sampled_finer_than_a_ball_at_equal_cost():
    rope, ball = line_and_ball()
    # One node per voxel: 0.6 m / 100 along the rope is finer than its section; (4 pi r^2 = 0.08 m^2) / 100 on the ball's surface.
    assert voxel_for(rope, 100, 0.002) < 0.011
    assert 0.02 < voxel_for(ball, 100, 0.002) < 0.05


def test_a_chosen_spacing_is_written_down_and_only_then(tmp_path):
    capture, _, cloud, _ = film(tmp_path, 2)
    row = ScenarioRow(scenario="x", source="capture", category="rope", path="x", self_collision=False, ground=True)
    lifted = tracked(cloud[::7])
    for nodes in (None, 30):
        settings = Perception(sample=Sampling(voxel=0.004, nodes=nodes))
        seen = assemble(row, capture, lifted, shape.no_prior(), settings)
        written = seen.scenario.provenance.get("node spacing")
        if nodes is None:
            assert written is None
            assert len(seen.nodes) > 30
        else:
            assert float(written.removesuffix(" m")) > 0.004
            assert len(seen.nodes) <= 30
