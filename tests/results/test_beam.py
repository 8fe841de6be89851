"""The silicone beam: its law from a ring-down with a known law, and its twins against closed forms."""

import numpy as np
import pytest

from results.published.beam import make as study
from results.published.stand_ins import RELAXED, SHARES, released


def test_the_law_of_a_ring_down_is_found_and_says_how_it_rings(tmp_path):
    paths = [
        released(tmp_path, f"beam_gravity_V2_{take}.c3d", held, seed=k) for k, (take, held) in enumerate((("a", 6e-3), ("b", 7e-3)))
    ]
    recordings = [study.Recording.read(path) for path in paths]
    assert [(one.take, one.load, one.released) for one in recordings] == [("a", 0.0, 72), ("b", 0.0, 72)]
    assert recordings[0].change[1] == pytest.approx(-6e-3, rel=0.01), "it is still creeping at the end"
    law = study.fit_law(recordings)
    assert law.relaxed == pytest.approx(RELAXED, rel=0.005)
    assert law.shares.sum() == pytest.approx(SHARES.sum(), rel=0.05)
    assert law.residual == pytest.approx(1e-5 / 3**0.5, rel=0.1)
    frequency, decrement = law.rings(law.relaxed)
    seen = study._ringing(recordings[0])
    assert frequency == pytest.approx(seen[0], rel=0.01)
    assert decrement == pytest.approx(seen[1], rel=0.1)


def test_twins_bend_and_ring_as_beams_do():
    """A rod as Euler's beam, q L^4 / 8 EI and 3.516 sqrt(EI / q L^4) / 2 pi. A lattice shears too, and gives way more."""
    stiffness, line = 1e7 * study.WIDTH**4 / 12, study.MASS / study.LENGTH
    drop = line * study.GRAVITY * study.LENGTH**4 / 8 / stiffness
    rod, lattice = study.KINDS["rod"], study.KINDS["lattice_coarse"]
    along, up, turn = rod.static(1e7, 0.0)
    assert (-up, turn) == pytest.approx((drop, drop * 4 / 3 / study.LENGTH), rel=0.01) and abs(along) < 1e-5
    # A frequency is that at 1e5 Pa.
    first = 3.516 / (2 * np.pi) * np.sqrt(stiffness / 100 / line) / study.LENGTH**2
    assert rod.frequency(0.0) == pytest.approx(first, rel=0.005)
    assert 1.1 < lattice.static(1e7, 0.0)[1] / up < 1.3
    # Drop times frequency squared does not depend on the modulus: 1.545 g / (2 pi)^2 of Euler's beam, less with turning sections.
    product = -lattice.static(1e7, 0.0)[1] * lattice.frequency(0.0) ** 2 * 100
    assert product == pytest.approx(1.545 * study.GRAVITY / (2 * np.pi) ** 2, rel=0.06)
