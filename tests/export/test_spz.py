"""SPZ: read by a reader of its own, written from the format's description; every attribute is within its quantization."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.export import spz
from neuspring.export.source import read_source
from tests.support import exported

POSITION, SCALE, OPACITY, COLOR, HARMONIC, ANGLE = 2**-17, 1 / 32, 0.5 / 255, 0.5 / (255 * 0.15), 0.5 / 128, 0.35
"""Half steps of m, log m, opacity and coefficients; degrees of orientation. Coefficients of +1 do not fit and become 127 / 128."""


def decoded(content):
    """Splats of a file, in the axes that our PLY has. One splat and one value at a time, unlike the writer."""
    data = gzip.decompress(content)
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    assert len(data) == 16 + count * (9 + 1 + 3 + 3 + 4 + 3 * ((degree + 1) ** 2 - 1))
    sizes = np.cumsum([16, 9 * count, count, 3 * count, 3 * count, 4 * count])
    at = dict(zip(("means", "opacity", "color", "scale", "turn", "rest"), map(int, sizes), strict=True))
    means = [int.from_bytes(data[at["means"] + 3 * k :][:3], "little", signed=True) / 2**bits for k in range(3 * count)]
    opacities = [data[at["opacity"] + k] / 255 for k in range(count)]
    colors = [(data[at["color"] + k] / 255 - 0.5) / 0.15 for k in range(3 * count)]
    scales = [data[at["scale"] + k] / 16 - 10 for k in range(3 * count)]
    rest = [data[at["rest"] + k] / 128 - 1 for k in range(3 * count * ((degree + 1) ** 2 - 1))]
    turns = []
    for k in range(count):
        (word,) = struct.unpack_from("<I", data, at["turn"] + 4 * k)
        largest, turn = word >> 30, [0.0] * 4
        for component in (3, 2, 1, 0):
            if component != largest:
                turn[component] = (word & 511) / 511 / 2**0.5 * (-1 if word >> 9 & 1 else 1)
                word >>= 10
        turn[largest] = (1 - sum(value**2 for value in turn)) ** 0.5
        x, y, z, w = turn
        turns.append([w, x, -y, -z])
    places = np.reshape(means, (count, 3)) * [1, -1, -1]
    colors, scales = np.reshape(colors, (-1, 3)), np.reshape(scales, (-1, 3))
    return places, opacities, colors, scales, np.array(turns), np.reshape(rest, (count, -1, 3))


@pytest.mark.parametrize(("degree", "axes"), [(0, 1), (1, 3), (2, 3), (3, 3)])
def test_every_attribute_is_within_its_quantization(degree, axes):
    splats = exported.splats(200, degree)
    splats = replace(splats, log_scales=splats.log_scales[:, :axes])
    means, opacities, colors, scales, turns, rest = decoded(spz.encoded(splats))
    assert np.abs(means - splats.means).max() <= POSITION * 1.01
    assert np.abs(opacities - 1 / (1 + np.exp(-splats.opacity_logits))).max() <= OPACITY * 1.01
    assert np.abs(colors - splats.harmonics[:, 0]).max() <= COLOR * 1.01
    assert np.abs(scales - splats.log_scales).max() <= SCALE * 1.01
    unit = splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    assert np.degrees(2 * np.arccos(np.abs((unit * turns).sum(axis=1)).clip(0, 1))).max() < ANGLE
    signs = spz.TURN_HARMONICS[: rest.shape[1], None]
    assert rest.shape[1] == (degree + 1) ** 2 - 1
    assert np.abs(rest * signs - splats.harmonics[:, 1:]).max(initial=0) <= HARMONIC * 1.01


def test_harmonics_turn_with_the_axes():
    """A color seen along d is, of turned coefficients, seen along the turned d."""
    import torch

    from neuspring.splats.view import basis

    directions = torch.nn.functional.normalize(torch.tensor(np.random.default_rng(0).normal(size=(50, 3))), dim=-1)
    turned = basis(directions * torch.tensor(spz.TURN), 3)[:, 1:]
    assert torch.allclose(turned, basis(directions, 3)[:, 1:] * torch.tensor(spz.TURN_HARMONICS))


def test_the_command_writes_a_file_per_frame(tmp_path):
    folder = exported.run_folder(tmp_path)
    assert main(["export", str(folder), "--to", "spz", "--frames", "0:3:2", "--output", str(tmp_path / "out")]) == 0
    moved = dict(read_source(folder).moved_splats([0, 2]))
    for frame in (0, 2):
        means = decoded((tmp_path / "out" / f"splats_{frame:05d}.spz").read_bytes())[0]
        assert np.abs(means - moved[frame].means).max() <= POSITION * 1.01
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_splats_far_away_have_fewer_bits_and_must_fit():
    assert [spz.fractional_bits(np.array([[x, 0.0, 0.0]])) for x in (1.0, 300.0, 8e6)] == [16, 14, 0]
    with pytest.raises(InputError, match="must lie within"):
        spz.fractional_bits(np.array([[9e6, 0.0, 0.0]]))
