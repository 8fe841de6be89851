"""The stability bound: sharp for one oscillator, valid for lattices, reported with node, bound and next step."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.physics import lanczos, stability
from neuspring.physics.stability import STABILITY_LIMIT, Spectrum
from tests.support.scenes import Scene, random_scene, scene, twin_of, warp

MARGIN = 0.01
"""Relative distance of dt from the bound on either side."""
GROWTH = 100.0
"""Threshold between bounded and diverging after 400 substeps. 1 % beyond the bound amplifies by exp(0.28) each without dashpot
and by 1.02 with dashpot alone; 1 % below it a bounded motion swells by up to 1 / sin(theta) = 5 at first."""
LANCZOS = 2e-3
"""Relative, of an eigenvalue from `eigsh` with tol=1e-3, which approaches it from below."""
LENGTH = 0.5


def held_node(substep: float, stiffness: float, dashpot: float) -> Scene:
    """One node on a spring to a controller: lambda = Y / l0, c = gamma."""
    return scene(1, [(1, 0)], [LENGTH], stiffness=stiffness, dashpot=dashpot, frame_time=substep)


@pytest.mark.parametrize(("stiffness", "dashpot"), [(80.0, 0.0), (80.0, 20.0), (1e-6, 20.0)])
def test_the_bound_is_sharp_for_an_oscillator(stiffness, dashpot):
    """Just below dt^2 lambda + 2 dt c = 4 a small extension stays small, just above it diverges."""
    largest = Spectrum(stiffness / LENGTH, dashpot, 0).largest_substep(1.0)
    start = 1e-9
    reached = []
    for factor in (1 - MARGIN, 1 + MARGIN):
        body = held_node(factor * largest, stiffness, dashpot)
        hands = np.tile([[[LENGTH, 0.0, 0.0]]], (401, 1, 1))
        x, _ = warp(body, np.array([[start, 0.0, 0.0]]), np.array([[start / largest, 0.0, 0.0]]), hands)
        reached.append(np.abs(x[:, 0, 0]).max() / start)
    assert reached[0] < GROWTH
    assert reached[1] > GROWTH


def matrices(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """Dense K and C at rest, assembled spring by spring."""
    t, m = twin.topology, twin.material
    ends = np.concatenate([t.nodes, t.controllers]).astype(np.float64)
    result = np.zeros((2, 3 * len(t.nodes), 3 * len(t.nodes)))
    for (i, j), k, c in zip(t.springs, m.stiffness.astype(np.float64) / t.rest_lengths, m.dashpot, strict=True):
        d = (ends[j] - ends[i]) / np.linalg.norm(ends[j] - ends[i])
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            if a < len(t.nodes) and b < len(t.nodes):
                block = sign * np.outer(d, d)
                result[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += np.array([k, c])[:, None, None] * block
    return result[0], result[1]


def random_twin(seed: int, **simulation: object) -> Twin:
    body, x, _, hands = random_scene(seed, nodes=15, **simulation)
    return twin_of(body, x, hands[0])


@pytest.mark.parametrize("seed", range(2))
def test_spectrum_of_a_net(seed):
    """Lanczos finds the eigenvalues of the dense matrices, from below."""
    twin = random_twin(seed)
    spectrum = stability.twin_spectrum(twin)
    for value, matrix in zip((spectrum.stiffness, spectrum.damping), matrices(twin), strict=True):
        exact = np.linalg.eigvalsh(matrix)[-1]
        assert exact * (1 - LANCZOS) <= value <= exact * (1 + 1e-9)


def test_no_springs_are_always_stable():
    twin = twin_of(scene(2), np.zeros((2, 3)), np.zeros((0, 3)))
    assert stability.twin_spectrum(twin) == Spectrum(0.0, 0.0, 0)
    stability.check(twin)


def refused(twin: Twin) -> str:
    with pytest.raises(InputError) as caught:
        stability.check(twin)
    return str(caught.value)


@pytest.mark.parametrize("seed", range(2))
def test_check_names_node_bound_and_remedy(seed):
    twin = random_twin(seed, frame_time=0.5, substeps=2)
    spectrum, message = stability.twin_spectrum(twin), refused(twin)
    assert f"node {spectrum.node}" in message
    assert f"below {spectrum.largest_substep(1.0):.3g} s" in message
    assert "received 0.25 s (2 substeps per frame)" in message
    assert "substeps: auto" in message
    # The remedy works, and it is the smallest that does.
    match = re.search(r"at least (\d+) substeps", message)
    assert match
    needed = int(match[1])
    stability.check(with_substeps(twin, needed))
    refused(with_substeps(twin, needed - 1))


def with_substeps(twin: Twin, count: int) -> Twin:
    return Twin(topology=twin.topology, material=twin.material, simulation=replace(twin.simulation, substeps=count))


@pytest.mark.parametrize("safety", [1.0, 0.8, 0.3])
def test_smallest_safe_substeps_is_smallest(safety):
    spectrum, frame_time = Spectrum(3.7e5, 130.0, 0), 1 / 30
    for one in (spectrum, Spectrum(0.0, 40.0, 0), Spectrum(1e6, 0.0, 0)):
        assert one.load(one.largest_substep(safety)) == pytest.approx(STABILITY_LIMIT * safety)
    assert Spectrum(0.0, 0.0, 0).largest_substep(safety) == np.inf
    count = stability.smallest_safe_substeps(spectrum, frame_time, safety)
    assert spectrum.load(frame_time / count) < STABILITY_LIMIT * safety <= spectrum.load(frame_time / (count - 1))
    assert stability.smallest_safe_substeps(Spectrum(1.0, 0.0, 0), 1e-3, safety) == 1


@pytest.mark.parametrize("load", [2.4, 3.6])
def test_a_prediction_keeps_the_sign_of_a_damped_mode(load):
    """Two nodes on a dashpot: c = 2 gamma, so their relative velocity is 1 - load / 2 times itself after a substep."""
    gamma, frame_time = 300.0, 1 / 30
    substeps = int(np.ceil(frame_time * 4 * gamma / load))
    body = scene(2, [(1, 0)], [0.1], stiffness=1e-6, dashpot=gamma, frame_time=frame_time, substeps=substeps, self_collision=True)
    x = np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])

    def relative_velocity(twin: Twin) -> np.ndarray:
        one = replace(body, simulation=replace(body.simulation, frame_time=twin.simulation.substep, substeps=1))
        _, v = warp(one, x, np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]]), np.zeros((5, 0, 3)))
        return v[:, 0, 0] - v[:, 1, 0]

    twin = twin_of(body, x, np.zeros((0, 3)))
    assert (relative_velocity(twin) < 0).any()
    predicted = stability.for_prediction(twin)
    assert (relative_velocity(predicted) > 0).all()
    assert stability.for_prediction(predicted) == predicted


def test_a_spectrum_that_does_not_converge_is_above_the_value(monkeypatch):
    twin, value = random_twin(0), stability.twin_spectrum(random_twin(0)).stiffness
    monkeypatch.setattr(lanczos, "MOST", lanczos.STEPS)
    monkeypatch.setattr(stability, "TOLERANCE", -1.0)
    assert value < stability.twin_spectrum(twin).stiffness < 1.5 * value


@pytest.mark.parametrize("seed", range(2))
def test_a_spectrum_is_that_of_the_matrices(seed):
    """Nearer than its tolerance: the error of an eigenvalue is that of its mode squared."""
    twin = random_twin(seed)
    for matrix, value in zip(matrices(twin), vars(stability.twin_spectrum(twin)).values(), strict=False):
        assert value == pytest.approx(np.linalg.eigvalsh(matrix)[-1], rel=1e-5)


def test_masses_change_the_spectrum():
    """Two nodes on a spring: lambda = k (1/m_1 + 1/m_2)."""
    points, pairs = np.array([[0.0, 0, 0], [0.1, 0.1, 0]]), np.array([[0, 1]])
    k, c, mass = np.array([30.0]), np.array([4.0]), np.array([0.25, 2.0])
    found = stability.rest_spectrum(pairs, points, np.zeros((0, 3)), k, c, mass)
    assert (found.stiffness, found.damping) == (pytest.approx(30.0 * 4.5, rel=1e-3), pytest.approx(4.0 * 4.5, rel=1e-3))
