"""The rasterizer against golden pictures and gradients (`tests/golden`), central differences, and bad input; the gsplat
backend through a stand-in with the interface of gsplat 1.5, since gsplat itself needs CUDA. On a GPU the real one is compared.

Tolerances are those of the golden data for single precision on stable pixels; r04 has splats centimeters before the camera.
"""

import dataclasses
import sys
import types

import numpy as np
import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.splats.blend import blend, tiles
from neuspring.splats.rasterize import _gsplat_fault, choose_backend, rasterize
from neuspring.splats.train import Statistics
from neuspring.splats.view import DEFAULT_LIMITS, Limits, View, boxes, harmonic_colors, project, radii
from tests.support.devices import DEVICES
from tests.support.golden_splats import CASES, Golden, random_splats, small_view

CLOSE = "r04_culling"
SINGLE = {"rgb": 2e-5, "alpha": 2e-5, "depth": 1e-4, "gradient": 1e-4, "loss": 2e-5}
SINGLE_CLOSE = {"rgb": 2e-4, "alpha": 2e-4, "depth": 5e-4, "gradient": 1e-3, "loss": 2e-5}
DOUBLE = dict.fromkeys(SINGLE, 1e-9)
"""float64 reaches 1e-10; a digit is left for the order of sums."""
PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
ISOTROPIC = ("r01_single_iso", "r07_sh0_iso", "r10_sh_partial")


def tolerances(case, dtype):
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


def test_gradients_are_those_of_central_differences():
    splats = random_splats(3, 12, torch.float64)
    view = small_view()
    # No threshold nearby: where one lies, the picture jumps.
    limits = dataclasses.replace(DEFAULT_LIMITS, alpha_min=1e-12, transmittance_min=1e-12)
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


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10, radius_clip=0.0,
    eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None, render_mode="RGB",
):  # fmt: skip
    """Keyword names and shapes of gsplat.rasterization; the picture is ours."""
    assert not packed
    assert render_mode == "RGB+ED"
    assert torch.allclose(quats.norm(dim=1), torch.ones(()))
    limits, view = Limits(near=near_plane, far=far_plane, blur=eps2d), View(viewmats[0], Ks[0], width, height)
    ellipses = project(means, quats, scales, view, limits)
    touching, rectangles = boxes(ellipses, opacities[ellipses.index].detach(), view, limits)
    visible = touching.nonzero().squeeze(1)
    index = ellipses.index[visible]
    flat = means.new_zeros(len(means), 2).index_put((ellipses.index,), ellipses.means)[None]
    shade = colors[index] if sh_degree is None else harmonic_colors(colors[index], means[index] - view.position, sh_degree)
    features = torch.cat([shade, ellipses.depths[visible, None]], dim=1)
    lists = tiles(ellipses.depths[visible].detach(), rectangles[visible], view)
    total, left = blend(lists, view, limits, flat[0, index], ellipses.conics[visible], opacities[index], features)
    alpha = 1 - left
    size = torch.zeros(1, len(means), 2, dtype=torch.int32)
    size[0, index] = radii(ellipses)[visible, None].ceil().int()
    picture = torch.cat([total[..., :3], (total[..., 3] / alpha.clamp_min(1e-10))[..., None]], dim=-1)
    return picture[None], alpha[None, ..., None], {"means2d": flat, "radii": size}


@pytest.fixture
def stand_in(monkeypatch):
    module = types.ModuleType("gsplat")
    module.rasterization = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", module)


@pytest.mark.parametrize("degree", [None, 2])
def test_pictures_and_gradients_are_handed_on(stand_in, degree):
    splats = [tensor.detach().requires_grad_() for tensor in random_splats(4, 50, torch.float32)]
    if degree is not None:
        splats[4] = torch.rand(50, 9, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    options = {"degree": degree, "background": (0.1, 0.2, 0.3)}
    ours, theirs = (rasterize(*splats, small_view(), **options, backend=name) for name in ("warp", "gsplat"))
    assert (ours.backend, theirs.backend) == ("warp", "gsplat")
    for name in ("rgb", "alpha", "depth"):
        assert torch.allclose(getattr(ours, name), getattr(theirs, name), atol=1e-5)
    assert torch.equal(ours.index, theirs.index)
    gradients = [torch.autograd.grad(one.rgb.sum() + one.alpha.sum(), splats, retain_graph=True) for one in (ours, theirs)]
    for mine, other in zip(*gradients, strict=True):
        assert torch.allclose(mine, other, atol=1e-3 * float(mine.abs().max()) + 1e-6)
    # Density adapts by the same statistics.
    own, found = (Statistics.empty(splats[0]) for _ in "ab")
    for picture, statistics in ((ours, own), (theirs, found)):
        picture.rgb.sum().backward(retain_graph=True)
        statistics.add(picture, 37, 29)
    assert own.pull.max() > 0 and torch.allclose(own.pull, found.pull, rtol=1e-3, atol=1e-5) and torch.equal(own.seen, found.seen)


def test_thresholds_that_gsplat_would_not_keep_are_refused(stand_in):
    splats = random_splats(0, 4, torch.float32)
    with pytest.raises(InputError, match="gsplat has fixed thresholds"):
        rasterize(*splats, small_view(), limits=Limits(alpha_max=0.9), backend="gsplat")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available() or bool(_gsplat_fault("cuda:0")), reason="needs CUDA and gsplat")
def test_gsplat_draws_what_we_draw():
    assert choose_backend("auto", "cuda:0") == "gsplat"
    splats = [tensor.detach().cuda() for tensor in random_splats(4, 200, torch.float32)]
    view = small_view()
    view = View(view.world_to_camera.float().cuda(), view.intrinsics.float().cuda(), view.width, view.height)
    # gsplat's clamp of coverage is 0.99.
    splats[3] = splats[3].clamp(max=0.95)
    splats = [tensor.requires_grad_() for tensor in splats]
    ours, theirs = (rasterize(*splats, view, limits=DEFAULT_LIMITS, backend=name) for name in ("warp", "gsplat"))
    assert (ours.rgb - theirs.rgb).abs().mean() < 1e-4
    assert (ours.alpha - theirs.alpha).abs().mean() < 1e-4
    gradients = [torch.autograd.grad(one.rgb.sum() + one.alpha.sum(), splats) for one in (ours, theirs)]
    for mine, other in zip(*gradients, strict=True):
        assert (other - mine).norm() < 1e-2 * mine.norm()
