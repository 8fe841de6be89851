"""LPIPS with random weights: its definition written out slowly, its ranges, and every way in which weights can be absent."""

import importlib.util
import shutil
from pathlib import Path

import pytest
import torch

from neuspring.core import weights as weight_files
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.scores import lpips as module
from neuspring.scores.lpips import Lpips, find_weights
from tests.support.devices import DEVICES

CHANNELS = (64, 192, 384, 256, 256)
CONVOLUTIONS = {"0": (64, 3, 11, 11), "3": (192, 64, 5, 5), "6": (384, 192, 3, 3), "8": (256, 384, 3, 3), "10": (256, 256, 3, 3)}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
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
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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
    """The distance of [3, H, W], in float64, with torch's layers and loops over pixels."""
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
    for picture in (a, b):
        x = torch.stack(
            [
                ((2 * plane.double() - 1 if scaled else plane.double()) - shift) / scale
                for plane, shift, scale in zip(picture, (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450), strict=True)
            ]
        )[None]
        layers = []
        for stage in stages:
            x = stage(x)
            if isinstance(stage, torch.nn.ReLU):
                layers.append(x[0].detach())
        found.append(layers)
    total = 0.0
    for k, (first, second) in enumerate(zip(*found, strict=True)):
        weights, (_, height, width) = heads[f"lin{k}.model.1.weight"].double().flatten(), first.shape
        for i in range(height):
            for j in range(width):
                p, q = (f[:, i, j] / (f[:, i, j].pow(2).sum().sqrt() + 1e-10) for f in (first, second))
                total += float((weights * (p - q) ** 2).sum()) / (height * width)
    return total


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


def test_every_picture_of_a_batch_has_its_distance(files):
    distance = Lpips.load(*files, trusted=True)
    a, b = pair(3, 40, 35)
    together = distance(a, b)
    assert together.shape == (3,)
    assert torch.allclose(together, torch.stack([distance(*one) for one in zip(a, b, strict=True)]), rtol=1e-5)
    assert torch.allclose(distance(a.double(), b.double()), together)


def test_the_gradient_is_finite_where_nothing_is_felt(files):
    """A picture on which all channels of a ReLU are silent has features of length 0."""
    distance = Lpips.load(*files, trusted=True)
    silent = Lpips(distance.kernels, [torch.full_like(bias, -1e3) for bias in distance.biases], distance.heads)
    a, b = pair(40, 40)
    (gradient,) = torch.autograd.grad(silent(a.requires_grad_(), b), a)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(
    ("a", "b", "rule"),
    [
        ((3, 30, 40), (3, 30, 40), "at least 31 x 31 px"),
        ((3, 40, 30), (3, 40, 30), "at least 31 x 31 px"),
        ((1, 40, 40), (1, 40, 40), "two pictures"),
        ((40, 40), (40, 40), "two pictures"),
        ((3, 40, 40), (3, 40, 41), "same shape"),
    ],
)
def test_bad_pictures_are_refused(files, a, b, rule):
    with pytest.raises(InputError, match=rule):
        Lpips.load(*files, trusted=True)(torch.zeros(a), torch.zeros(b))


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


def test_an_unreadable_cached_file_is_a_reason(hub, monkeypatch):
    (hub / "alexnet-owt-7be5be79.pth").write_bytes(b"")

    def denied(path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(weight_files, "digest_file", denied)
    assert "cannot be read (Permission denied)" in str(find_weights())


@pytest.mark.parametrize("at", [0, 1])
def test_given_files_are_checked(files, tmp_path, at):
    for path, rule in ((tmp_path / "absent.pth", "is not there"), (files[at], "has SHA-256")):
        given = {("backbone", "heads")[at]: path}
        with pytest.raises(InputError, match=rule) as raised:
            find_weights(**given)
        assert str(path) in str(raised.value)
        with pytest.raises(InputError, match=rule):
            Lpips.load(**given)


def damage(kind: str, path: Path, values: dict[str, torch.Tensor], whole: bytes) -> str:
    """Write a damaged weight file; the rule that its refusal names."""
    name = next(key for key in values if key.endswith("weight") and key.startswith(("features", "lin")))
    if kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
        return "must hold weights"
    if kind == "code":
        torch.save({name: importlib.util.find_spec}, path)
        return "must hold weights"
    if kind == "list":
        torch.save([1, 2], path)
        return "must hold a state dict"
    changed = {
        "absent": {key: value for key, value in values.items() if key != name},
        "shape": values | {name: values[name][:, :1]},
        "kind": values | {name: values[name].int()},
        "nan": values | {name: values[name] * float("nan")},
    }
    torch.save(changed[kind], path)
    return f"`{name}` must be a finite float tensor"


@pytest.mark.parametrize("at", [0, 1])
@pytest.mark.parametrize("kind", ["truncated", "code", "list", "absent", "shape", "kind", "nan"])
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
