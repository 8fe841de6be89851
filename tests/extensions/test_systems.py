"""Stages of the baselines by hand: records name their files, failures are kept and passed on, nothing reads the future."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from neuspring import config
from neuspring.baselines import BASELINES
from neuspring.config.extensions import Baselines
from neuspring.config.images import Appearance, Images
from neuspring.core.artifacts import Observations, SplatCenters, Trajectory
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder, StageRecord
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph
from neuspring.extensions.gs_dynamics.model import GsDynamicsModel
from neuspring.extensions.gs_dynamics.model import predict as predicted
from neuspring.extensions.gs_dynamics.settings import GsDynamics
from neuspring.extensions.spring_gaus.model import SpringGausModel, SpringGausTraining
from neuspring.extensions.spring_gaus.settings import SpringGaus
from neuspring.scores import metrics
from neuspring.scores.table import collect
from neuspring.stages.predict import predict
from neuspring.stages.score import score
from neuspring.stages.train import train
from neuspring.stages.transfer import transfer
from tests.support import small
from tests.support.filmed import FRAMES, film
from tests.support.pictured import Scene, pictured

ROOT = Path(__file__).parents[2]
POINTS = SpringGaus(supervision="points", anchors=60, iterations=2)
MASKS = replace(POINTS, supervision="masks", anchors=150)
NETWORK = GsDynamics(width=8, batch=2, epochs=1, updates_per_epoch=2, step=0.002)


def settings(**models):
    return config.Config(baselines=Baselines(**{"spring_gaus": POINTS, "gs_dynamics": NETWORK} | models), device="cpu")


@pytest.fixture
def seen(tmp_path):
    path = tmp_path / "small" / "observations.npz"
    small.observations().save(path)
    return path


def run_all(seen, model, chosen):
    """Train, predict and score; returns the path of run.json."""
    folder = seen.parent / model / "0"
    trained = None
    if BASELINES[model].trained:
        trained = folder / "train.json"
        train(observations=seen, model=model, settings=chosen, seed=0, device="cpu", output=trained)
    predict(observations=seen, model=model, train=trained, appearance=None, device="cpu", output=folder / "rollout.json")
    records = ({"train": trained} if trained else {}) | {"rollout": folder / "rollout.json"}
    score(observations=seen, **records, method=model, variant={"model": model}, seed=0, output=folder / "run.json")
    return folder / "run.json"


@pytest.mark.parametrize("model", ["static", "controller_lbs", "spring_gaus", "gs_dynamics"])
def test_every_model_passes_through_every_stage(seen, model):
    run = run_all(seen, model, settings())
    record = json.loads(run.read_text())
    assert (record["status"], record["held_file"]) == ("ok", None)
    trained = BASELINES[model].trained
    assert ("train" in record["timings"], "train" in record["histories"]) == (trained, trained)
    assert set(pd.read_parquet(run.with_name("scores.parquet"))["task"]) == {"reconstruction", "future"}
    assert set(collect(seen.parents[1], ["small"], [model], [0]).runs["status"]) == {"ok"}
    if trained:
        history = pd.read_parquet(run.with_name("history.parquet"))
        assert list(history.columns) == ["step", "metric", "value"] and "loss" in set(history["metric"])
        assert StageRecord.load(run.with_name("train.json")).settings["model"] == model
        assert not run.with_name("train.partial.npz").exists()


@pytest.mark.parametrize("model", ["spring_gaus", "gs_dynamics"])
def test_training_reads_no_frame_of_the_future(seen, tmp_path, model):
    other = tmp_path / "other" / "observations.npz"
    small.spoiled_future().save(other)
    found = []
    for path in (seen, other):
        train(observations=path, model=model, settings=settings(), seed=0, device="cpu", output=path.with_name("train.json"))
        found.append(StageRecord.load(path.with_name("train.json")).files["model"][1])
    assert found[0] == found[1]


def test_a_network_moves_to_another_recording(seen, tmp_path):
    out, target = seen.parent / "gs_dynamics" / "0", tmp_path / "other" / "observations.npz"
    other = small.scene("rope/shake/smooth").observations
    other.save(target)
    train(observations=seen, model="gs_dynamics", settings=settings(), seed=0, device="cpu", output=out / "train.json")
    transfer(
        targets=[target],
        learned=out / "train.json",
        method="gs_dynamics",
        seed=0,
        settings=settings(),
        device="cpu",
        output=out / "transfer.json",
    )
    scores = pd.read_parquet(out / "transfer.parquet")
    model = GsDynamicsModel.load(out / "model.npz")
    frames = {"transfer": range(1, other.scenario.frame_count)}
    wanted = metrics.score(predicted(model, other, None, "cpu").trajectory, other, "gs_dynamics", 0, tasks=frames)
    pd.testing.assert_frame_equal(scores, wanted)


def test_a_training_that_breaks_is_a_failure_whose_run_is_held_and_counted(seen, monkeypatch):
    stiff = SpringGausTraining(supervision="points", anchors=60, iterations=2, stiffness=1e12, substeps=1, max_substeps=2)
    monkeypatch.setattr("neuspring.extensions.spring_gaus.train.SpringGausTraining", lambda **settings: stiff)
    run = run_all(seen, "spring_gaus", settings())
    record = json.loads(run.read_text())
    trained = StageRecord.load(run.with_name("train.json"))
    assert trained.status == "failed" and "the anchors left the scene" in trained.reason
    assert SpringGausModel.load(trained.file("model", run.with_name("train.json"))).substeps == 2
    assert record["status"] == "failed"
    # Both are said: training ended, and the model that was left diverged too.
    assert record["reason"].startswith("train: training ended early") and "rollout: anchor" in record["reason"]
    held = pd.read_parquet(run.with_name(record["held_file"]))
    assert set(held["task"]) == {"reconstruction", "future"}
    still = json.loads(run_all(seen, "static", settings()).read_text())
    static = pd.read_parquet(seen.parent / "static" / "0" / still["scores_file"])
    # It diverges in the first frame, so frame 0 is held.
    np.testing.assert_allclose(held["value"], static["value"])


def test_splats_that_failed_and_too_few_anchors_are_failures_that_are_counted(seen, tmp_path, monkeypatch):
    learned = tmp_path / "appearance.json"
    Recorder("appearance", learned).save(failure="appearance: step 3 removed the last splat")
    pictures = {"appearance": learned}
    out = seen.with_name("train.json")
    train(
        observations=seen, model="spring_gaus", settings=settings(spring_gaus=MASKS), seed=0, device="cpu", output=out, **pictures
    )
    found = StageRecord.load(out)
    assert (found.status, found.files) == ("failed", {}) and "removed the last splat" in found.reason
    lonely = SpringGausTraining(supervision="points", anchors=60, iterations=2, neighbors=500)
    monkeypatch.setattr("neuspring.extensions.spring_gaus.train.SpringGausTraining", lambda **settings: lonely)
    run = run_all(seen, "spring_gaus", settings())
    record = json.loads(run.read_text())
    assert record["status"] == "failed" and "more anchors than neighbors (500) are required" in record["reason"]
    assert set(pd.read_parquet(run.with_name(record["held_file"]))["task"]) == {"reconstruction", "future"}


def test_all_that_training_reads_is_in_its_record(seen):
    out = seen.with_name("train.json")
    train(observations=seen, model="spring_gaus", settings=settings(), seed=0, device="cpu", output=out)
    found = StageRecord.load(out).settings
    assert found["simulation"]["gravity"] == 9.8 and found["losses"]["track"] == 1.0
    assert found["baselines"]["spring_gaus"]["anchors"] == 60


def test_what_is_missing_is_named(seen):
    with pytest.raises(InputError, match="must be a model with training: gs_dynamics, spring_gaus"):
        train(observations=seen, model="static", settings=settings(), seed=0, device="cpu", output=seen.with_name("train.json"))
    with pytest.raises(InputError, match="supervision: masks requires --capture"):
        train(
            observations=seen,
            model="spring_gaus",
            settings=settings(spring_gaus=MASKS),
            seed=0,
            device="cpu",
            output=seen.with_name("train.json"),
        )
    out = seen.with_name("rollout.json")
    with pytest.raises(InputError, match="model gs_dynamics requires a training"):
        predict(observations=seen, model="gs_dynamics", train=None, appearance=None, device="cpu", output=out)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A film whose motion is known, with splats of Spring-Gaus' kind."""
    folder = tmp_path_factory.mktemp("filmed")
    scene = Scene(film(folder / "capture"), folder)
    scene.learn(pictured(appearance=Appearance(iterations=60, degree=0, start="shape_prior", fixed_radius=0.004, spacing=2.0)))
    return scene


def test_silhouettes_train_and_both_outputs_are_written(filmed):
    chosen = replace(settings(spring_gaus=MASKS), images=Images())
    pictures = {"capture": filmed.capture.folder / "capture.json", "masks": filmed.masks, "appearance": filmed.appearance}
    seen, out = filmed.folder / "observations.npz", filmed.folder / "spring_gaus"
    train(observations=seen, model="spring_gaus", settings=chosen, seed=0, device="cpu", output=out / "train.json", **pictures)
    trained = StageRecord.load(out / "train.json")
    assert trained.status == "ok" and trained.facts["vgg16"].startswith("no VGG16 weights")
    assert {"masks0", "appearance", "observations"} <= set(trained.inputs)
    predict(
        observations=seen,
        model="spring_gaus",
        train=out / "train.json",
        appearance=filmed.appearance,
        device="cpu",
        output=out / "rollout.json",
    )
    record = StageRecord.load(out / "rollout.json")
    centers = SplatCenters.load(record.file("centers", out / "rollout.json")).positions
    trajectory = Trajectory.load(record.file("trajectory", out / "rollout.json"))
    assert len(centers) == len(trajectory.positions) == FRAMES
    # Structure points begin where they are; splats, bound by absolute positions, already shrink towards their anchors.
    np.testing.assert_allclose(trajectory.positions[0], Observations.load(seen).nodes, atol=1e-6)
    assert record.facts["frame0_shift"] > 0
    assert record.facts["centers_chamfer_reconstruction"] > 0
    drawn, _ = filmed.render(out / "rollout.json", pictured())
    assert drawn.status == "ok" and drawn.facts["splats"] == centers.shape[1]
    run = out / "run.json"
    records = {"train": out / "train.json", "rollout": out / "rollout.json", "render": out / "render.json"}
    score(observations=seen, **(records | {"appearance": filmed.appearance}), method="spring_gaus", variant={}, seed=0, output=run)
    assert "without the loss of VGG16's features" in " ".join(json.loads(run.read_text())["notes"])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{model: spring_gaus, settings: {anchor: 9}, description: x}", "method bad, settings: .*anchor: unknown key"),
        ("{model: spring_gaus, settings: {anchors: 0}, description: x}", "method bad, settings: .*anchors: .*received 0"),
        ("{model: spring_gaus, appearance: {degrees: 0}, description: x}", "method bad, appearance: .*degrees: unknown key"),
        ("{model: spring_gaus, description: x}", "at least one method must apply to a scenario"),
    ],
)
def test_rows_with_settings_that_cannot_be(row, message, tmp_path):
    (tmp_path / "bad.yaml").write_text(f"bad: {row}\n")
    with pytest.raises(InputError, match=re.compile(message, re.DOTALL)):
        Benchmark({"scenarios": ["toy_rope_lift_smooth"], "methods": ["bad"], "method_table": str(tmp_path / "bad.yaml")}, ROOT)


def test_what_is_trained_on_silhouettes_needs_images_and_is_left_out_elsewhere(tmp_path):
    names = ["spring_gaus", "spring_gaus_points", "gs_dynamics", "static", "spring_gaus_few"]
    rows = config.read_yaml(ROOT / "config" / "methods.yaml")
    few = rows["spring_gaus"] | {"settings": {"anchors": 100}}
    (tmp_path / "methods.yaml").write_text(yaml.safe_dump(rows | {"spring_gaus_few": few}))
    values = config.read_yaml(ROOT / "config" / "data" / "demo.yaml") | {"methods": names}
    values["method_table"] = str(tmp_path / "methods.yaml")
    values |= {"scenarios": ["synthetic_single_lift_rope", "toy_rope_lift_smooth"]}
    made = Benchmark(values, ROOT)
    assert made.pictured == {"spring_gaus", "spring_gaus_few"}
    assert made.applies("spring_gaus", "synthetic_single_lift_rope")
    assert not made.applies("spring_gaus", "toy_rope_lift_smooth")
    assert made.applies("spring_gaus_points", "toy_rope_lift_smooth")
    left_out = {"toy_rope_lift_smooth": "it needs images"}
    assert made.whole_left_out == {"spring_gaus": left_out, "spring_gaus_few": left_out}
    # The same splats are made once; who trains on points draws with those of all methods.
    assert Graph(made).owners["appearance"] == {"spring_gaus": "spring_gaus", "spring_gaus_few": "spring_gaus"}
    assert not made.searches
    blind = Benchmark(values | {"images": {"enabled": False}}, ROOT)
    assert blind.whole_left_out["spring_gaus"] == dict.fromkeys(values["scenarios"], "it needs images")
