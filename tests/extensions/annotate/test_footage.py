"""One click per point on real color film, where it is, against points that were marked by hand."""

import numpy as np
import pytest

from neuspring.extensions.annotate.clicks import Click, GrayImages, follow
from results.published.footage.film import Points, film
from tests.support.films import Errors, Film
from tests.support.real import FOOTAGE


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_one_click_per_point_follows_the_rope():
    case = "single_lift_rope"
    own = Points.load(FOOTAGE / "tracks" / f"{case}.json")
    images = GrayImages(Film(film(FOOTAGE, case)))
    places = np.stack([follow(images, "0", [Click(frame=0, x=float(x), y=float(y))]).places for x, y in own.xy[:, 0]], axis=1)
    found = Errors.of(own, places, np.isfinite(places[..., 0]))
    assert found.shown == 18
    assert found.lost < 0.2
    assert found.median < 2.5
