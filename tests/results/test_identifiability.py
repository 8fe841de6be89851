"""The metrics of results/published/identifiability/make.py; finished runs are not repeated."""

import functools

import numpy as np
import pytest

from results.published.identifiability import make as study
from tests.support import small


@functools.cache
def scene():
    return small.scene("blob/shake/smooth", frames=10)


def test_the_truth_is_recovered_and_a_constant_is_not():
    exact = study.compare(scene().truth, scene())
    assert exact["rms"] == exact["node_rms"] == 0
    assert exact["correlation"] == pytest.approx(1)
    assert exact["training_loss"] < 1e-10 and exact["future_track_error"] < 1e-5
    start = study.compare(study.constant(scene().truth, 0.6), scene())
    assert "correlation" not in start and "node_correlation" not in start
    log = np.log10(scene().truth.material.stiffness[: scene().truth.topology.object_spring_count].astype(float))
    middle = np.log10(scene().truth.material.stiffness.astype(float)).mean()
    assert start["rms"] == pytest.approx(np.sqrt(np.mean((np.log10(0.6) + middle - log) ** 2)), rel=1e-5)
    assert start["training_loss"] > exact["training_loss"]
