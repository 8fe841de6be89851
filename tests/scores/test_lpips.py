"""LPIPS with random weights: a slow definition, its ranges, and every kind of missing weights."""

import importlib.util
import shutil
from pathlib import Path

import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.scores import lpips as module
from neuspring.scores.lpips import Lpips, find_weights
from tests.support.devices import DEVICES

CHANNELS = (64, 192, 384, 256, 256)
CONVOLUTIONS = {"0": (64, 3, 11, 11), "3": (192, 64, 5, 5), "6": (384, 192, 3, 3), "8": (256, 384, 3, 3), "10": (256, 256, 3, 3)}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights in the layout of the real files, with the classifier's that are not used."""
    folder = tmp_path_factory.mktemp("weights")
    generator = torch.Generator().manual_seed(3)
    backbone = {"classifier.1.weight": torch.zeros(2, 3)}
    for name, shape in CONVOLUTIONS.items():
        fan = shape[1] * shape[2] * shape[3]
        backbone[f"features.{name}.weight"] = torch.randn(shape, generator=generator) * (2 / fan) ** 0.5
        backbone[f"features.{name}.bias"] = torch.randn(shape[0], generator=generator) * 0.1
    heads = {f"lin{k}.model.1.weight": torch.rand((1, c, 1, 1), generator=generator) for k, c in enumerate(CHANNELS)}
    torch.save(backbone, folder / "backbone.pth")
    torch.save(heads, folder / "heads.pth")
    return folder / "backbone.pth", folder / "heads.pth"


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty cache of torch hub, and no package that carries heads."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(module, "PACKAGED_HEADS", {})
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def pair(*shape: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    return [torch.rand((*shape[:-2], 3, *shape[-2:]), generator=generator) for _ in range(2)]


def slow(files: tuple[Path, Path], a: torch.Tensor, b: torch.Tensor, scaled: bool) -> float:
    """The distance of [3, H, W], in float64, with torch's layers."""
    backbone, heads = (torch.load(path, weights_only=True) for path in files)
    stages = torch.nn.Sequential(
        torch.nn.Conv2d(3, 64, 11, stride=4, padding=2), torch.nn.ReLU(), torch.nn.MaxPool2d(3, 2),
        torch.nn.Conv2d(64, 192, 5, padding=2), torch.nn.ReLU(), torch.nn.MaxPool2d(3, 2),
        torch.nn.Conv2d(192, 384, 3, padding=1), torch.nn.ReLU(),
        torch.nn.Conv2d(384, 256, 3, padding=1), torch.nn.ReLU(),
        torch.nn.Conv2d(256, 256, 3, padding=1), torch.nn.ReLU(),
    )  # fmt: skip
    stages.load_state_dict({k.removeprefix("features."): v for k, v in backbone.items() if k.startswith("features.")})
    stages.double()
    found = []
    shift, scale = (torch.tensor(v, dtype=torch.float64)[:, None, None] for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)))
    for picture in (a, b):
        x, layers = (((2 * picture.double() - 1 if scaled else picture.double()) - shift) / scale)[None], []
        for stage in stages:
            x = stage(x)
            if isinstance(stage, torch.nn.ReLU):
                layers.append(x[0].detach() / (x[0].detach().pow(2).sum(0).sqrt() + 1e-10))
        found.append(layers)
    weights = [heads[f"lin{k}.model.1.weight"][0].double() for k in range(5)]
    return sum(float((w * (p - q) ** 2).sum(0).mean()) for w, p, q in zip(weights, *found, strict=True))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("released_range", [False, True])
@pytest.mark.parametrize("size", [(31, 31), (48, 70)])
def test_the_distance_is_its_definition(files, size, released_range, device):
    a, b = pair(*size)
    found = Lpips.load(*files, device, trusted=True)(a, b, released_range=released_range)
    assert found.shape == () and found.device.type == torch.device(device).type
    assert found.item() == pytest.approx(slow(files, a, b, not released_range), rel=1e-5)


def test_distances_are_zero_for_equal_pictures_and_symmetric(files):
    distance = Lpips.load(*files, trusted=True)
    a, b = pair(2, 40, 35)
    assert distance(a, a).tolist() == [0.0, 0.0]
    assert (distance(a, b) > 0).all()
    assert torch.allclose(distance(a, b), distance(b, a), rtol=1e-6)
    nothing = torch.zeros(3, 40, 35)
    assert distance(nothing, nothing) == 0


def test_the_gradient_is_finite_where_nothing_is_felt(files):
    """A picture on which all channels of a ReLU are silent has features of length 0."""
    silent = Lpips.load(*files, trusted=True)
    for layer in silent.layers:
        if isinstance(layer, torch.nn.Conv2d):
            layer.bias.fill_(-1e3)
    a, b = pair(40, 40)
    (gradient,) = torch.autograd.grad(silent(a.requires_grad_(), b), a)
    assert gradient.isfinite().all()


def test_absent_weights_are_a_reason(hub):
    reason = find_weights()
    assert isinstance(reason, str) and "\n" not in reason
    assert f"no AlexNet weights: {hub / 'alexnet-owt-7be5be79.pth'} is not there" in reason
    assert f"no LPIPS heads: {hub / 'lpips_alex_v0.1.pth'} is not there" in reason
    with pytest.raises(InputError, match="no AlexNet weights"):
        Lpips.load()


def test_cached_weights_are_found(hub, files, monkeypatch):
    for source, name in zip(files, ("alexnet-owt-7be5be79.pth", "lpips_alex_v0.1.pth"), strict=True):
        shutil.copy(source, hub / name)
    reason = find_weights()
    assert isinstance(reason, str)
    for path, expected in ((hub / "alexnet-owt-7be5be79.pth", "7be5be79"), (hub / "lpips_alex_v0.1.pth", "df73285e")):
        assert f"{path} has SHA-256 {digest_file(path)[:8]}..., not {expected}..." in reason
    assert find_weights(trusted=True) == (hub / "alexnet-owt-7be5be79.pth", hub / "lpips_alex_v0.1.pth")
    monkeypatch.setattr(module, "BACKBONE_DIGEST", digest_file(files[0])[:8])
    assert find_weights() == reason.partition("; ")[2]
    monkeypatch.setattr(module, "HEADS_DIGEST", digest_file(files[1]))
    assert isinstance(find_weights(), tuple)
    a, b = pair(40, 40)
    assert Lpips.load()(a, b) == Lpips.load(*files, trusted=True)(a, b)


def test_heads_are_found_in_a_package_without_importing_it(hub, files, tmp_path, monkeypatch):
    package = tmp_path / "carries_heads"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    shutil.copy(files[1], package / "weights/alex.pth")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(module, "PACKAGED_HEADS", {"carries_heads": "weights/alex.pth", "absent_package": "alex.pth"})
    found = find_weights(files[0], trusted=True)
    assert found == (files[0], package / "weights/alex.pth")
    # A stale file in the cache does not hide the good one.
    (hub / "lpips_alex_v0.1.pth").write_bytes(b"stale")
    monkeypatch.setattr(module, "BACKBONE_DIGEST", digest_file(files[0]))
    monkeypatch.setattr(module, "HEADS_DIGEST", digest_file(files[1]))
    assert find_weights(files[0]) == found


def damage(kind: str, path: Path, values: dict[str, torch.Tensor], whole: bytes) -> str:
    """Write a damaged weight file; the rule that its refusal names."""
    name = next(key for key in values if key.endswith("weight") and key.startswith(("features", "lin")))
    if kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
        return "must contain weights"
    if kind == "code":
        torch.save({name: importlib.util.find_spec}, path)
        return "must contain weights"
    changed = {
        "shape": values | {name: values[name][:, :1]},
        "nan": values | {name: values[name] * float("nan")},
    }
    torch.save(changed[kind], path)
    return f"`{name}` must be a finite float tensor"


@pytest.mark.parametrize("at", [0, 1])
@pytest.mark.parametrize("kind", ["truncated", "code", "shape", "nan"])
def test_damaged_given_files_are_named(files, tmp_path, kind, at):
    path = tmp_path / "damaged.pth"
    rule = damage(kind, path, torch.load(files[at], weights_only=True), files[at].read_bytes())
    given = [path if i == at else file for i, file in enumerate(files)]
    with pytest.raises(InputError, match=rule) as raised:
        Lpips.load(*given, trusted=True)
    assert str(path) in str(raised.value)
    if kind == "truncated":
        with pytest.raises(InputError, match="has SHA-256"):
            find_weights(**{("backbone", "heads")[at]: path})
