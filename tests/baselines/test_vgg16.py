"""Features of VGG16 on weights made here: the layers are those of torchvision's network, the file is known by its digest."""

import pytest
import torch

from neuspring.baselines import spring_gaus
from neuspring.baselines.spring_gaus.train import FEATURES, load_features, silhouette_loss
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file


@pytest.fixture
def network():
    """Layers 0 to 8 of torchvision's `features`, with random weights."""
    torch.manual_seed(0)
    convolutions = [torch.nn.Conv2d(before, after, 3, padding=1) for before, after in ((3, 64), (64, 64), (64, 128), (128, 128))]
    first, second, third, fourth = convolutions
    relu, pool = torch.nn.ReLU(), torch.nn.MaxPool2d(2, 2)
    return torch.nn.Sequential(first, relu, second, relu, pool, third, relu, fourth, relu)


def stored(network: torch.nn.Module, folder):
    path = folder / "vgg16.pth"
    torch.save({f"features.{name}": value for name, value in network.state_dict().items()}, path)
    return path


def test_features_are_those_of_the_network(network, tmp_path):
    features = load_features(stored(network, tmp_path), "cpu")
    pictures = torch.rand(2, 3, 20, 28, generator=torch.Generator().manual_seed(1))
    shift, scale = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    wanted = network((pictures - shift[:, None, None]) / scale[:, None, None])
    assert wanted.shape == (2, 128, 10, 14)
    torch.testing.assert_close(features(pictures), wanted)


def test_the_term_of_the_loss_is_weighted_and_differentiable(network, tmp_path):
    features = load_features(stored(network, tmp_path), "cpu")
    drawn = torch.rand(16, 24, generator=torch.Generator().manual_seed(2), requires_grad=True)
    mask = (drawn.detach() > 0.5).float()
    term = silhouette_loss(drawn, mask, features) - silhouette_loss(drawn, mask, None)
    found = features(torch.stack([drawn, mask])[:, None].expand(-1, 3, -1, -1))
    torch.testing.assert_close(term, FEATURES * (found[0] - found[1]).square().mean(), rtol=1e-4, atol=1e-6)
    term.backward()
    assert drawn.grad.abs().sum() > 0


def test_a_file_is_known_by_its_digest_and_a_damaged_one_is_named(network, tmp_path, monkeypatch):
    path = stored(network, tmp_path)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    assert "vgg16-397923af.pth is not there" in spring_gaus.find_vgg16(None)
    with pytest.raises(InputError, match="must be the file of VGG16 weights; received has SHA-256"):
        spring_gaus.find_vgg16(str(path))
    monkeypatch.setattr(spring_gaus, "DIGEST", digest_file(path)[:8])
    assert spring_gaus.find_vgg16(str(path)) == path
    damaged = stored(network[:-2], tmp_path)
    with pytest.raises(InputError, match=r"`features\.7\.weight` must be a float tensor \[128, 128, 3, 3\]; received NoneType"):
        load_features(damaged, "cpu")
