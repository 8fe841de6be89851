"""results/published/identifiability/make.py measures what it says, and repeats no finished run."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.scenes import toy
from results.published.identifiability import make as study
from tests.support import small


@functools.cache
def scene() -> toy.ToyScene:
    return small.scene("blob/shake/smooth", frames=10)


def test_the_truth_is_recovered_and_a_constant_is_not() -> None:
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


def test_a_node_has_the_mean_of_its_springs() -> None:
    topology = scene().truth.topology
    doubled = scene().truth.material.stiffness.copy()
    doubled[0] *= 10
    scores = study.compare(replace(scene().truth, material=replace(scene().truth.material, stiffness=doubled)), scene())
    degree = np.bincount(topology.springs[: topology.object_spring_count].ravel())
    expected = np.sqrt((1 / degree[topology.springs[0]] ** 2).sum() / len(topology.nodes))
    assert scores["node_rms"] == pytest.approx(expected, rel=1e-4)


def test_a_finished_run_is_found_again_by_its_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "scene_of", lambda *_: scene())
    run = study.Run("blob/shake/smooth", 0.0, 0, "field", 1)
    assert run.record(tmp_path) is None
    record = study.execute(run, tmp_path)
    assert run.record(tmp_path) == record
    assert len(record["stiffness"]) == scene().truth.topology.object_spring_count
    assert replace(run, epochs=2).record(tmp_path) is None


def test_the_report_pairs_field_and_springs() -> None:
    values = {"truth": 0.0, "start": 0.3, "constant": 0.2, "springs": 0.15, "field": 0.1}
    rows = [(s, 5e-4, n, k, "rms", v + 0.01 * n) for s in ("a", "b") for n in (0, 1) for k, v in values.items()]
    text = "\n".join(study.report(pd.DataFrame(rows, columns=["scene", "noise", "seed", "kind", "metric", "value"])))
    assert "field − springs" in text and "0.155 ± 0.007" in text
    assert "-0.050 [-0.050, -0.050]" in text
