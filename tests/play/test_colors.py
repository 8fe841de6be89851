"""Colors of springs: the drawn ones are those of the legend."""

import numpy as np
import pytest

from neuspring.play.colors import LINEAR, linear, strain_scale


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
