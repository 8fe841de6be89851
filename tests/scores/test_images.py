"""SSIM, PSNR, IoU and the masked pair against golden values (tests/golden/m01..m03) and their rules."""

from pathlib import Path

import numpy as np
import pytest
import torch

from neuspring.scores.pictures import _ssim_on_black, iou, masked_pair, psnr, silhouettes
from neuspring.splats.losses import ssim, ssim_map
from tests.support.devices import DEVICES

FOLDER = Path(__file__).parents[1] / "golden"
SINGLE = {"mean": 1e-5, "map": 1e-4, "gradient": 1e-3, "psnr": 1e-4, "relative": 1e-5}
"""The golden README's tolerances for float32: SSIM absolute, its gradient relative to the largest, PSNR in dB."""
DOUBLE = dict.fromkeys(SINGLE, 1e-9)
CASES = range(8)


def golden(name: str) -> dict[str, np.ndarray]:
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


@pytest.fixture(scope="module")
def m01():
    return golden("m01_images")


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request):
    return request.param


def random_pair(*shape: int, dtype: torch.dtype = torch.float64) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    return [torch.rand(shape, generator=generator, dtype=dtype) for _ in range(2)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("k", CASES)
def test_similarity_is_golden(m01, k, dtype, device):
    allowed = DOUBLE if dtype == torch.float64 else SINGLE
    a, b = (torch.tensor(m01[f"{name}{k}"], dtype=dtype, device=device) for name in "ab")
    a.requires_grad_()
    values = ssim_map(a, b)
    assert values.shape == a.shape and values.dtype == dtype
    mean = ssim(a, b)
    (gradient,) = torch.autograd.grad(mean, a)
    assert abs(mean.item() - m01[f"exp_ssim{k}"]) <= allowed["mean"]
    per_image = values.mean(dim=(-3, -2, -1)).detach().cpu().numpy()
    assert np.abs(per_image - m01[f"exp_ssim_per_image{k}"]).max() <= allowed["mean"]
    if k in (1, 4, 5):
        assert np.abs(values.detach().cpu().numpy() - m01[f"exp_ssim_map{k}"]).max() <= allowed["map"]
    if k in (1, 3, 4):
        expected = m01[f"exp_ssim_grad{k}"]
        assert np.abs(gradient.cpu().numpy() - expected).max() <= allowed["gradient"] * np.abs(expected).max()
    photo = 0.8 * (a - b).abs().mean() + 0.2 * (1 - mean)
    assert photo.item() == pytest.approx(m01[f"exp_photo{k}"], rel=allowed["relative"], abs=allowed["relative"])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("k", CASES)
def test_psnr_and_differences_are_golden(m01, k, dtype, device):
    allowed = DOUBLE if dtype == torch.float64 else SINGLE
    a, b = (torch.tensor(m01[f"{name}{k}"], dtype=dtype, device=device) for name in "ab")
    found = psnr(a, b)
    assert found.shape == a.shape[:-3]
    assert found.cpu().numpy() == pytest.approx(m01[f"exp_psnr{k}"].reshape(found.shape), abs=allowed["psnr"])
    per_channel = psnr(a.unsqueeze(-3), b.unsqueeze(-3)).cpu().numpy()
    assert per_channel == pytest.approx(m01[f"exp_psnr_per_channel{k}"].reshape(per_channel.shape), abs=allowed["psnr"])
    assert (a - b).abs().mean().item() == pytest.approx(m01[f"exp_l1_{k}"], rel=allowed["relative"])
    assert (a - b).square().mean().item() == pytest.approx(m01[f"exp_mse{k}"], rel=allowed["relative"])


def test_the_evaluation_is_golden():
    values = golden("m02_eval_pipeline")
    scores = []
    for observed, mask, rendered, hand in zip(*(values[key] for key in ("gt", "mask", "render", "human")), strict=True):
        pair = masked_pair(observed, mask, rendered, hand)
        for picture in pair:
            assert picture.shape == (3, *mask.shape) and picture.dtype == torch.float32
            assert picture.min() >= 0 and picture.max() <= 1
        scores.append((psnr(*pair).item(), ssim(*pair).item(), iou(*silhouettes(mask, rendered, hand))))
    for name, found, allowed in zip(("psnr", "ssim", "iou"), np.array(scores).T, (1e-4, 1e-5, 0.0), strict=True):
        assert np.abs(found - values[f"exp_{name}"]).max() <= allowed
        assert abs(found.mean() - values[f"exp_mean_{name}"]) <= max(allowed, 1e-15)


def test_overlap_is_golden():
    values = golden("m03_iou")
    assert [iou(*pair) for pair in zip(values["mask_a"], values["mask_b"], strict=True)] == values["exp_iou"].tolist()
    # Any byte but 0 is foreground, not alpha above one half.
    in_bytes = np.floor(255 * values["alpha"].astype(np.float64) + 0.5).astype(np.uint8)
    assert np.array_equal(in_bytes, values["exp_alpha_u8"])
    rendered = np.repeat(in_bytes[..., None], 4, axis=-1)
    seen, drawn = silhouettes(values["mask_b"][0].astype(np.uint8) * 255, rendered, np.zeros_like(in_bytes))
    assert iou(drawn, seen) == values["exp_alpha_iou_vs_mask_b0"]


def test_gradients_are_those_of_central_differences():
    a, b = random_pair(2, 7, 12)
    assert torch.autograd.gradcheck(ssim_map, (a.requires_grad_(), b.requires_grad_()))
    assert torch.autograd.gradcheck(psnr, (a, b))


def test_masks_weigh_by_their_value():
    observed, rendered = np.full((1, 2, 3), 200, np.uint8), np.full((1, 2, 4), 100, np.uint8)
    mask, hand = np.array([[255, 51]], np.uint8), np.array([[51, 0]], np.uint8)
    truth, drawn = masked_pair(observed, mask, rendered, hand)
    assert truth[0, 0].tolist() == pytest.approx([200 / 255 * 0.8, 200 / 255 * 0.2])
    assert drawn[2, 0].tolist() == pytest.approx([100 / 255 * 0.8, 100 / 255])


@pytest.mark.parametrize("box", [(10, 20, 12, 30), (0, 6, 0, 9), (30, 40, 40, 48), (0, 40, 0, 48)])
def test_ssim_of_pictures_on_black_is_that_of_the_whole(box):
    """Scored pairs: an object on black, also at the border."""
    top, bottom, left, right = box
    a, b = torch.zeros(3, 40, 48), torch.zeros(3, 40, 48)
    generator = torch.Generator().manual_seed(0)
    for picture in (a, b):
        picture[:, top:bottom, left:right] = torch.rand(3, bottom - top, right - left, generator=generator)
    assert _ssim_on_black(a, b) == pytest.approx(float(ssim(a.double(), b.double())), abs=1e-6)
    assert _ssim_on_black(a, a) == pytest.approx(1.0)
    assert _ssim_on_black(0 * a, 0 * a) == 1.0
