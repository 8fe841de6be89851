"""The gsplat backend through a stand-in with the interface of gsplat 1.5, since gsplat itself needs CUDA: how it is called, and
what becomes of its answer. On a GPU with gsplat the real one is compared with ours."""

import sys
import types

import pytest
import torch

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError
from neuspring.splats.blend import blend, tiles
from neuspring.splats.rasterize import _gsplat_fault, choose_backend, rasterize
from neuspring.splats.train import Statistics, densify
from neuspring.splats.view import LIMITS, Limits, View, boxes, harmonic_colors, project, radii
from tests.support.random_splats import random_splats, small_view


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


def test_density_adapts_alike(stand_in, monkeypatch):
    changes = []
    for backend in ("warp", "gsplat"):
        splats = [tensor.detach().requires_grad_() for tensor in random_splats(4, 50, torch.float32)]
        picture = rasterize(*splats, small_view(), backend=backend)
        picture.rgb.sum().backward()
        statistics = Statistics.empty(splats[0])
        statistics.add(picture, 37, 29)
        named = {
            "means": splats[0].detach(),
            "quaternions": splats[1].detach(),
            "log_scales": splats[2].detach().log(),
            "opacity_logits": torch.logit(splats[3].detach(), 1e-6),
        }
        threshold = float((statistics.pull / statistics.seen.clamp_min(1)).median())
        monkeypatch.setattr("neuspring.splats.train.DENSIFY_GRADIENT", threshold)
        stay, added = densify(named, statistics, Appearance(), 1.0, False, torch.Generator().manual_seed(0))
        changes.append((stay, len(added["means"])))
    assert changes[0][1] == changes[1][1] > 5
    assert torch.equal(changes[0][0], changes[1][0])


def test_thresholds_that_gsplat_would_not_keep_are_refused(stand_in):
    splats = random_splats(0, 4, torch.float32)
    with pytest.raises(InputError, match="gsplat keeps its own thresholds"):
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
    ours, theirs = (rasterize(*splats, view, limits=LIMITS, backend=name) for name in ("warp", "gsplat"))
    assert (ours.rgb - theirs.rgb).abs().mean() < 1e-4
    assert (ours.alpha - theirs.alpha).abs().mean() < 1e-4
