"""Time of a recording and colors of springs: what a player shows."""

import numpy as np
import pytest

from neuspring.extensions.play.colors import LINEAR, linear, strain_scale
from neuspring.extensions.play.player import Clock


def clock(**changes) -> Clock:
    return Clock(count=10, rate=20.0, border=7, playing=True, **changes)


def test_time_runs_at_the_recorded_rate_times_the_speed():
    one = clock(speed=0.5)
    assert not one.advance(0.05) and one.advance(0.05)
    assert one.frame == 1


@pytest.mark.parametrize(("loop", "frame"), [(True, 1), (False, 9)])
def test_it_starts_again_or_stops_at_the_end(loop, frame):
    one = clock(loop=loop)
    one.advance(0.55)
    assert (one.frame, one.playing) == (frame, loop)


@pytest.mark.parametrize(("frame", "part"), [(0, "training"), (6, "training"), (7, "future"), (99, "future"), (-5, "training")])
def test_the_border_is_shown(frame, part):
    one = clock()
    one.show(frame)
    assert one.part == part and f"{part} frame {one.frame} of 9" in one.bar()


def test_a_color_that_is_shown_as_linear_light_is_the_one_of_the_legend():
    codes = np.arange(256)
    light = LINEAR / 255
    shown = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    # Eight bits of linear light are coarse where it is dark.
    assert shown == pytest.approx(codes, abs=7)
    assert shown[64:] == pytest.approx(codes[64:], abs=2)
    assert np.array_equal(linear(np.array([[0, 255, 0]], np.uint8)), [[0, 255, 0]])


def test_strains_beyond_the_ends_have_the_color_of_the_end():
    scale = strain_scale(0.3)
    low, end, beyond = scale.paint(np.array([-0.3, 0.3, 9.0]))
    assert np.array_equal(end, beyond) and end[0] > end[2] and low[2] > low[0]
    assert "-0.3" in scale.legend() and "[1]" in scale.legend()
