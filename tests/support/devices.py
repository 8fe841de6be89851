"""The devices that tests run on. Those on a GPU carry the marker `cuda`, by which `make gpu` selects them."""

import pytest
import torch

CUDA = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]
DEVICES = ["cpu", pytest.param("cuda:0", marks=CUDA)]
"""Values of the parameter `device`."""
COST_MEDIAN, COST_LARGEST = 1e-3, 5e-2
"""Relative, of a candidate's cost. Moved by 1e-6 the median is 2e-5, the largest 9e-3."""
LOSS = 2e-2
"""Relative, of an epoch's loss of a fit on a GPU. Moved by 1e-6 it is 3e-3."""
