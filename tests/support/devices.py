"""The devices that tests run on. Those on a GPU carry the marker `cuda`, by which `make gpu` selects them."""

import pytest
import torch

CUDA = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]
DEVICES = ["cpu", pytest.param("cuda:0", marks=CUDA)]
"""Values of the parameter `device`."""
