"""The rasterizer against golden pictures and gradients (`tests/golden`), its float64 specification, and bad input.

Tolerances are those of the golden data for single precision on stable pixels; r04 has splats centimeters before the camera.
"""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.errors import InputError
from neuspring.splats.rasterize import choose_backend, rasterize, reference
from neuspring.splats.view import LIMITS, project
from tests.support.devices import DEVICES
from tests.support.golden_splats import CASES, Golden
from tests.support.random_splats import random_splats, small_view

CLOSE = "r04_culling"
SINGLE = {"rgb": 2e-5, "alpha": 2e-5, "depth": 1e-4, "means": 1e-4, "conics": 1e-4, "gradient": 1e-4, "loss": 2e-5}
SINGLE_CLOSE = {"rgb": 2e-4, "alpha": 2e-4, "depth": 5e-4, "means": 1e-3, "conics": 1e-4, "gradient": 1e-3, "loss": 2e-5}
DOUBLE = dict.fromkeys(SINGLE, 1e-9)
"""float64 reaches 1e-10; a digit is left for the order of sums."""
PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
ISOTROPIC = ("r01_single_iso", "r07_sh0_iso", "r10_sh_partial")


def tolerances(case: str, dtype: torch.dtype) -> dict[str, float]:
    return DOUBLE if dtype == torch.float64 else SINGLE_CLOSE if case == CLOSE else SINGLE


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("case", CASES)
def test_pictures_and_gradients_are_the_golden_ones(case, precision, device):
    dtype = PRECISIONS[precision]
    allowed = tolerances(case, dtype)
    golden = Golden(case, dtype, device)
    stable = golden.values["stable"]
    for which in "AB":
        picture = rasterize(*golden.inputs.values(), golden.view, **golden.options)
        for name in ("rgb", "alpha", "depth"):
            result = getattr(picture, name).detach().cpu().numpy()
            error = np.abs(result - golden.values[f"exp_{name}"])[stable].max()
            assert error <= allowed[name], (name, error)
        loss = golden.loss(which, picture.rgb, picture.alpha, picture.depth)
        assert abs(float(loss.detach()) / float(golden.values[f"loss_{which}"]) - 1) <= allowed["loss"]
        gradients = torch.autograd.grad(loss, list(golden.inputs.values()), allow_unused=True)
        for name, gradient in zip(golden.inputs, gradients, strict=True):
            expected = golden.expected_gradient(which, name)
            result = np.zeros_like(expected) if gradient is None else gradient.cpu().numpy()
            # Where the exact gradient is zero there is no ratio to take.
            scale = 1.0 if name == "quats" and case in ISOTROPIC else np.abs(expected).max()
            assert np.abs(result - expected).max() <= allowed["gradient"] * scale, (which, name)


@pytest.mark.parametrize("case", CASES)
def test_projection_and_order_are_the_golden_ones(case):
    for dtype in PRECISIONS.values():
        golden, allowed = Golden(case, dtype), tolerances(case, dtype)
        v = golden.values
        ellipses = project(golden.inputs["means"], golden.inputs["quats"], golden.inputs["scales"], golden.view, golden.limits)
        seen = ellipses.index.numpy()
        assert np.array_equal(seen, np.flatnonzero(v["visible"]))
        assert np.abs(ellipses.means.detach().numpy() - v["exp_means2d"][seen]).max() <= allowed["means"]
        conics = v["exp_conics"][seen]
        difference = np.abs(ellipses.conics.detach().numpy() - conics).max(1) / np.abs(conics).max(1)
        assert difference.max() <= allowed["conics"]
        order = torch.sort(ellipses.depths.detach(), stable=True).indices
        assert np.array_equal(seen[order.numpy()], v["order"])


@pytest.mark.parametrize("case", CASES)
def test_the_specification_is_the_golden_data(case):
    golden = Golden(case, torch.float64)
    pictures = reference(*golden.inputs.values(), golden.view, **golden.options)
    for name, picture in zip(("rgb", "alpha", "depth"), pictures, strict=True):
        assert np.abs(picture.detach().numpy() - golden.values[f"exp_{name}"]).max() <= DOUBLE[name]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 60), side=st.sampled_from([(37, 29), (16, 16), (8, 41)]))
def test_any_scene_looks_as_the_specification_says(seed, count, side):
    """Tiles, lists and early stops change nothing, whatever the size of picture and splats."""
    splats = random_splats(seed, count, torch.float64)
    view = small_view(*side)
    picture = rasterize(*splats, view, background=(0.2, 0.3, 0.4))
    specification = reference(*splats, view, background=(0.2, 0.3, 0.4))
    for result, expected in zip((picture.rgb, picture.alpha, picture.depth), specification, strict=True):
        assert torch.allclose(result, expected, atol=1e-9)
    weights = torch.rand_like(picture.rgb)
    ours = torch.autograd.grad((picture.rgb * weights).sum() + picture.depth.sum(), splats)
    theirs = torch.autograd.grad((specification[0] * weights).sum() + specification[2].sum(), splats)
    for result, expected in zip(ours, theirs, strict=True):
        assert torch.allclose(result, expected, atol=1e-7 * max(1.0, float(expected.abs().max())))


def test_gradients_are_those_of_central_differences():
    splats = random_splats(3, 12, torch.float64)
    view = small_view()
    # No threshold nearby: where one lies, the picture jumps.
    limits = dataclasses.replace(LIMITS, alpha_min=1e-12, transmittance_min=1e-12)
    weights = torch.rand(view.height, view.width, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def loss(*tensors):
        picture = rasterize(*tensors, view, limits=limits)
        # The depth of almost nothing jumps where it becomes nothing; times its coverage it does not.
        depth = picture.alpha * picture.depth
        return (torch.cat([picture.rgb, picture.alpha[..., None], depth[..., None]], dim=-1) * weights).sum()

    assert torch.autograd.gradcheck(loss, splats, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_nothing_in_view_is_an_empty_picture_with_zero_gradients():
    splats = random_splats(0, 5, torch.float32)
    behind = [splats[0] * torch.tensor([1.0, 1.0, -1.0]), *splats[1:]]
    picture = rasterize(*behind, small_view(), background=(0.1, 0.2, 0.3))
    assert torch.equal(picture.alpha, torch.zeros_like(picture.alpha))
    assert torch.equal(picture.depth, torch.zeros_like(picture.depth))
    assert torch.allclose(picture.rgb, torch.tensor([0.1, 0.2, 0.3]).expand_as(picture.rgb))
    picture.rgb.sum().backward()
    assert not splats[0].grad.any()


def test_a_camera_among_the_splats_gives_a_finite_picture_and_finite_gradients():
    splats = random_splats(1, 300, torch.float32)
    centered = [splats[0] - torch.tensor([0.0, 0.0, 1.0]), *splats[1:]]
    picture = rasterize(*centered, small_view())
    (picture.rgb.sum() + picture.depth.sum()).backward()
    assert torch.isfinite(picture.rgb).all()
    assert all(torch.isfinite(tensor.grad).all() for tensor in splats)
    assert picture.alpha.max() > 0.5


def test_splats_that_are_not_finite_or_of_a_wrong_shape_are_named():
    for position, name in enumerate(("means", "quaternions", "scales", "opacities", "colors")):
        splats = [tensor.detach() for tensor in random_splats(0, 4, torch.float32)]
        splats[position][2] = float("nan")
        with pytest.raises(InputError, match=rf"splats, {name}.*finite.*1 of 4"):
            rasterize(*splats, small_view())
    splats = [tensor.detach() for tensor in random_splats(0, 4, torch.float32)]
    with pytest.raises(InputError, match=r"splats, scales.*\[4, 3\].*\(4, 1\)"):
        rasterize(*splats[:2], splats[2][:, :1], *splats[3:], small_view())
    with pytest.raises(InputError, match="degree 2 needs 9"):
        rasterize(*splats[:4], torch.zeros(4, 4, 3), small_view(), degree=2)


def test_gsplat_is_refused_with_a_reason_where_it_cannot_work():
    assert choose_backend("auto", "cpu") == "warp"
    with pytest.raises(InputError, match=r"gsplat must work.*needs CUDA"):
        choose_backend("gsplat", "cpu")
