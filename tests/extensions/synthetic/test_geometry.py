"""Implicit bodies, their tetrahedra and skins, hands."""

import numpy as np
import pytest

from neuspring.extensions.synthetic import bodies, meshes
from neuspring.extensions.synthetic.scenes import Hand, place
from neuspring.scenes import shapes


def closed(faces):
    """Every edge is used once in each direction."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward, backward = {tuple(e) for e in directed.tolist()}, {tuple(e[::-1]) for e in directed.tolist()}
    return len(forward) == len(directed) and forward == backward


def enclosed(vertices, faces):
    """Volume by the divergence theorem; positive if faces point outward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6.0)


POINTS = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))


def test_distances_by_hand():
    assert shapes.sphere((0, 0, 0), 0.1)(np.array([0.3, 0.0, 0.0])) == pytest.approx(0.2)
    assert shapes.capsule((0, 0, 0), (1, 0, 0), 0.1)(np.array([0.5, 0.3, 0.0])) == pytest.approx(0.2)
    assert shapes.capsule((0, 0, 0), (1, 0, 0), 0.1)(np.array([1.5, 0.0, 0.0])) == pytest.approx(0.4)
    np.testing.assert_allclose(shapes.ellipsoid((0, 0, 0), (0.1,) * 3)(POINTS), shapes.sphere((0, 0, 0), 0.1)(POINTS), atol=1e-12)


def test_the_surface_of_a_sphere_is_closed_outward_and_as_large():
    vertices, faces = shapes.surface(shapes.sphere((0.02, 0, 0), 0.05), (-0.1,) * 3, (0.1,) * 3, 0.004)
    assert closed(faces)
    np.testing.assert_allclose(np.linalg.norm(vertices - [0.02, 0, 0], axis=1), 0.05, atol=1e-4)
    assert enclosed(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=0.01)


def test_a_body_is_filled_to_its_surface():
    sdf = shapes.ellipsoid((0, 0, 0), (0.06, 0.04, 0.03))
    nodes, elements = meshes.fill(sdf, (-0.08,) * 3, (0.08,) * 3, 0.01)
    volumes = meshes.volumes(nodes, elements)
    assert (volumes > 0).all()
    assert meshes.altitudes(nodes, elements).min() >= 0.39 * meshes.LATTICE_ALTITUDE * 0.01
    assert volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.06 * 0.04 * 0.03, rel=0.06)
    skin = meshes.boundary(elements)
    assert closed(skin)
    assert enclosed(nodes, skin) == pytest.approx(volumes.sum())
    assert np.abs(sdf(nodes[np.unique(skin)])).mean() < 0.0015


def test_embedded_points_follow_affine_motion_exactly():
    nodes, elements = meshes.block((0, 0, 0), (0.3, 0.2, 0.1), (4, 3, 2))
    rng = np.random.default_rng(1)
    points = rng.uniform((-0.02,) * 3, (0.32, 0.22, 0.12), (50, 3))
    element, weights = meshes.embed(points, nodes, elements)
    matrix, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    moved = np.einsum("vkc,vk->vc", (nodes @ matrix.T + shift)[elements[element]], weights)
    np.testing.assert_allclose(moved, points @ matrix.T + shift, atol=1e-12)
    inside = ((points > 0) & (points < [0.3, 0.2, 0.1])).all(axis=1)
    assert (weights[inside] > -1e-12).all()


@pytest.mark.parametrize("make", [bodies.sloth, bodies.zebra, bodies.dinosaur])
def test_animals_are_whole_and_uneven(make):
    body = make(0.02, 0.01)
    assert not meshes.pieces(body.tetrahedra).any()
    assert body.nodes[:, 2].min() == pytest.approx(bodies.CLEARANCE)
    assert len(np.unique(body.youngs_modulus)) >= 3
    np.testing.assert_allclose(body.surface.follow(body.nodes), body.surface.rest, atol=1e-12)
    mass = (body.density * meshes.volumes(body.nodes, body.tetrahedra)).sum()
    assert 0.05 < mass < 0.3


@pytest.mark.parametrize("body", [bodies.cloth("scarf", 0.02, 0.01), bodies.rope("twine", 0.02, 0.01), bodies.package(0.03, 0.01)])
def test_goods_show_where_their_material_is(body):
    np.testing.assert_allclose(body.surface.follow(body.nodes), body.surface.rest, atol=1e-7)
    material = body.membrane if body.is_sheet else body.youngs_modulus
    assert material.max() > 2 * material.min()
    assert ((body.surface.colors >= 0) & (body.surface.colors <= 1)).all()
    np.testing.assert_allclose(body.surface.weights.sum(axis=1), 1.0)


def test_a_hand_reaches_its_keys_and_carries_its_mesh_rigidly():
    hand = Hand(((0.0, (0, 0, 0), (0, 0, 0)), (1.0, (0.1, 0, 0.2), (0, 0, np.pi / 2)), (2.0, (0, 0, 0), (0, 0, 0))))
    poses = hand.poses(np.array([0.0, 0.5, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(poses[:, :3], [[0, 0, 0], [0.05, 0, 0.1], [0.1, 0, 0.2], [0, 0, 0], [0, 0, 0]], atol=1e-12)
    moved = place(np.array([[0.01, 0, 0], [0, 0.02, 0.0], [0, 0, 0.03]]), poses)
    np.testing.assert_allclose(moved[2], [[0.1, 0.01, 0.2], [0.08, 0, 0.2], [0.1, 0, 0.23]], atol=1e-12)
