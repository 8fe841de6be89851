"""Sweeps: errors, trials, killed workers, the report."""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from optuna.trial import TrialState

from neuspring import config
from neuspring.config.settings import read_settings
from neuspring.config.tuning import Tune
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.experiments import benchmark
from neuspring.extensions.tuning import jobs, trial, worker
from neuspring.extensions.tuning.report import report
from neuspring.extensions.tuning.space import Plan
from neuspring.twin import fit as twin_fit
from neuspring.twin.fit import FitProblem, start_loss, tail_start
from tests.support import small
from tests.support.project import config_with

ROOT = Path(__file__).parents[3]
BASE = {
    "scenarios": ["small"],
    # Springs begin far too soft, so that a faster rate is better by a tenth, not by last digits that depend on the processor.
    "search": {"rollouts": 11, "fixed": ["stiffness"], "variables": {"stiffness": {"start": 1500.0}}},
    "fit": {"epochs": 3, "learning_rate": 1e-4},
}
METHODS = {
    "search_only": {"search": "uniform", "fit": None, "description": "No second stage"},
    "baseline": {"search": "uniform", "fit": "springs", "description": "Springs"},
}
FAST = {"fit.learning_rate": {"low": 1.0e-4, "high": 1.0e-1, "log": True}, "fit.horizon": {"choices": [1, 2]}}
"""Settings of the fit alone, so that one search serves all trials."""
RANGE = {"low": 1, "high": 2}


def settings(**changes):
    """The configuration whose method is varied."""
    values = json.loads(json.dumps(BASE))
    config.merge(values, changes)
    return config.parse(config.Config, values, "test")


def sweep(**changes):
    return config.parse(Tune, {"study": "small", "method": "baseline", "trials": 3, "space": FAST} | changes, "tune")


def furnish(root, observations=None):
    """Write the tables and observations that a sweep reads; returns its folder."""
    tables = {"methods": METHODS, "searches": {"uniform": {"clusters": 1, "description": "One region"}}}
    (root / "config").mkdir()
    for name, rows in tables.items():
        (root / "config" / f"{name}.yaml").write_text(yaml.safe_dump(rows))
    (observations or small.observations()).save(root / "observations.npz")
    return root / "study"


def work(folder, tune, base=None, number=0):
    """Run a worker; returns all trials of the sweep."""
    base, root = base or settings(), folder.parent
    worker.work(base, tune, [root / "observations.npz"], number, "cpu", folder / f"worker-{number}.json", root)
    return trials(folder, tune, base)


def trials(folder, tune, base=None):
    return worker.study_of(folder, tune, Plan.of(base or settings(), tune, folder.parent).facts()).get_trials()


@pytest.fixture
def folder(tmp_path):
    """The folder of a sweep that has not begun."""
    return furnish(tmp_path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A sweep of four trials, reported. Tests leave its trials as they are."""
    folder = furnish(tmp_path_factory.mktemp("tune"))
    tune = sweep(trials=4, space=FAST | {"fit.damping": {"choices": ["fixed", "homogeneous"]}})
    work(folder, tune)
    report(settings(), tune, folder / "summary.md", folder.parent)
    return folder, tune


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"fit.learning_rat": RANGE}, "learning_rat.*did you mean.*learning_rate"),
        ({"toy.frames": RANGE}, "must begin with simulation"),
        ({"fit.field": RANGE}, "not a section"),
        ({"fit.horizon.more": RANGE}, "an item of a setting"),
        ({"fit.horizon": {"low": 1, "high": 2.5}}, "fit.horizon = 2.5"),
        ({"clusters": {"low": 0, "high": 2}}, "at least 1"),
        ({"fit.damping": {"choices": ["fixed", "springs"]}}, "fit.damping = 'springs'"),
        ({"fit.learning_rate": {"low": -1.0, "high": 1.0}}, "fit.learning_rate = -1.0"),
        ({"fit.learning_rate": {"low": 0.1, "high": 1.0}}, "must include that of the method, 0.0001"),
        ({"fit.field.shuffled": {"choices": [True, False]}}, "must be a setting that method .* reads"),
        ({"fit.selection": {"choices": ["tail", "training_loss"]}}, "same in all trials"),
        ({"losses.chamfer": RANGE}, "same in all trials"),
        ({"fit.stiffness_range": {"choices": [[0.0, 1e5], [0.0, 2e5]]}}, "choices must be numbers"),
        ({"fit.horizon": {"low": 1}}, "low and high, or choices"),
        ({"fit.horizon": {"low": 2, "high": 1}}, "low < high"),
        ({"fit.horizon": {"low": 0, "high": 1, "log": True}}, "log"),
        ({"fit.horizon": {"low": 0, "high": 1, "step": 2}}, "step"),
        ({"fit.horizon": {"choices": [1]}}, "at least two"),
        ({"fit.horizon": {"choices": [1, 2], "low": 1}}, "either"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_space_that_cannot_be_is_refused_by_name(finished, space, words):
    with pytest.raises(InputError, match=f"(?is){words}"):
        Plan.of(settings(), sweep(space=space), finished[0].parent)


def test_what_a_sweep_cannot_go_on_with_is_refused(finished, tmp_path):
    folder, tune = finished
    with pytest.raises(InputError, match="must not contain a password"):
        sweep(storage="postgresql://me:secret@host:5432/studies")
    with pytest.raises(InputError, match=r"must be a setting that method .* reads"):
        Plan.of(settings(), sweep(method="search_only"), folder.parent)
    for method in ("oracle_neuspring", "nothing"):
        with pytest.raises(InputError, match="a gradient fit, and not an oracle"):
            Plan.of(config.Config(), sweep(method=method), ROOT)
    with pytest.raises(InputError, match="another base"):
        work(folder, tune, settings(fit={"epochs": 4}))
    with pytest.raises(InputError, match="must be those of other"):
        work(folder, tune, settings(scenarios=["other"]))
    with pytest.raises(InputError, match=r"0 to tune\.workers - 1 = 0"):
        work(folder, tune, number=1)
    with pytest.raises(InputError, match="must have begun"):
        report(settings(), tune, tmp_path / "summary.md", folder.parent)


def test_the_workflow_plans_what_a_worker_varies_and_refuses_sqlite_across_machines():
    tune = {"study": "s", "method": "neuspring", "workers": 2, "space": {"fit.horizon": {"choices": [1, 3, 10]}}}
    made = benchmark.Benchmark(config_with({"clusters": 8, "tune": tune}), ROOT)
    told = read_settings(jobs.settings(made))
    assert Plan.of(told, told.tune, ROOT) == Plan.of(made.config, made.config.tune, ROOT)
    jobs.check(made, cluster=False)
    with pytest.raises(InputError, match="workers on several machines need storage"):
        jobs.check(made, cluster=True)


def test_trial_0_is_the_method_as_it_is_and_a_finished_sweep_is_not_run_again(finished):
    folder, tune = finished
    made = trials(folder, tune)
    assert [one.state for one in made] == [TrialState.COMPLETE] * 4
    assert made[0].params == {"fit.learning_rate": 1e-4, "fit.horizon": 1, "fit.damping": "fixed"}
    rates = [one.params["fit.learning_rate"] for one in made]
    assert all(1e-4 <= rate <= 1e-1 for rate in rates) and len(set(rates)) == 4
    (search,) = folder.glob("search-*/search.json")
    assert json.loads(search.read_text())["attempts"] == 1, "trials that vary the fit alone share one search"
    assert len(work(folder, tune)) == 4


def test_the_report_names_the_best_trial_and_its_overlay_makes_it_a_method(finished):
    folder, tune = finished
    best = min(trials(folder, tune), key=lambda one: one.value)
    assert best.number != 0
    text = (folder / "summary.md").read_text()
    assert "4 of 4 trials: 4 complete, 0 pruned, 0 failed." in text
    assert text.index(f"| {best.number} ") < text.index("| 0 ")
    assert len(pd.read_csv(folder / "trials.csv")) == 4
    values = BASE | {"scenarios": ["toy_rope_lift_smooth"], "methods": ["search_only"]}
    config.merge(values, config.read_yaml(folder / "best.yaml"))
    tables = folder.parent / "config"
    values |= {"method_table": str(tables / "methods.yaml"), "search_table": str(tables / "searches.yaml")}
    bench = benchmark.Benchmark(values, ROOT)
    tuned = benchmark.with_method(bench.config, bench.methods["baseline_small"], "baseline_small").fit
    assert list(bench.methods) == ["baseline", "baseline_small"]
    assert {f"fit.{name}": getattr(tuned, name) for name in ("learning_rate", "horizon", "damping")} == best.params
    assert benchmark.with_method(bench.config, bench.methods["baseline"], "baseline").fit == settings().fit


def test_varied_search_settings_and_clusters_get_a_search_row(folder):
    space = {"clusters": {"low": 1, "high": 2}, "simulation.gravity": {"choices": [9.8, 9.7]}}
    tune = sweep(method="search_only", trials=2, space=space)
    best = min(work(folder, tune), key=lambda one: one.value).params
    report(settings(), tune, folder / "summary.md", folder.parent)
    overlay = config.read_yaml(folder / "best.yaml")
    rows = config.read_yaml(Path(overlay["extra_rows"]["search_only_small"]))
    assert rows["searches"]["search_only_small"]["clusters"] == best["clusters"]
    assert rows["methods"]["search_only_small"]["search"] == "search_only_small"
    assert overlay["simulation"] == {"gravity": best["simulation.gravity"]}


def test_no_test_frame_changes_any_trial(tmp_path, finished):
    folder, tune = finished
    assert not np.array_equal(small.spoiled_future().object_points, small.observations().object_points)
    spoiled = work(furnish(tmp_path, small.spoiled_future()), tune)
    assert [(one.value, one.params) for one in spoiled] == [(one.value, one.params) for one in trials(folder, tune)]


def test_the_search_does_not_see_the_tail(tmp_path, monkeypatch):
    monkeypatch.setattr(twin_fit, "TAIL_FRACTION", 0.4)
    scene = small.observations()
    end = tail_start(scene.scenario.train_end)
    heads = []
    for name, shift in {"as": 0.0, "changed": 1.0}.items():
        points = scene.object_points.copy()
        points[end:] += shift
        dataclasses.replace(scene, object_points=points).save(tmp_path / f"{name}.npz")
        made = trial.TrainingScene.of(tmp_path / f"{name}.npz", tmp_path / name)
        heads.append(made.head.read_bytes())
        assert len(Observations.load(made.head).object_points) == end < scene.scenario.train_end
        assert len(made.training.object_points) == scene.scenario.train_end < scene.scenario.frame_count
    assert heads[0] == heads[1]


@pytest.mark.parametrize("method", ["baseline", "search_only"])
def test_a_trial_is_judged_by_the_twin_that_the_tail_selects(folder, method, monkeypatch):
    monkeypatch.setattr(twin_fit, "TAIL_FRACTION", 0.4)
    base = settings(fit={"learning_rate": 2.0, "epochs": 8})
    tune = sweep(method=method, trials=1, space={"losses.acceleration": {"choices": [0.01, 0.02]}})
    (made,) = work(folder, tune, base)
    record = next(folder.glob("search-*/search.json"))
    problem = FitProblem(
        observations=trial.cut(small.observations(), small.observations().scenario.train_end),
        twin=Twin.load(StageRecord.load(record).file("twin", record)),
        fit=config.parse(config.Fit, config.plain(base.fit) | {"selection": "tail"}, "fit"),
        simulation=base.simulation,
        losses=base.losses,
        quirks=base.released_quirks,
    )
    if method == "search_only":
        assert made.value == start_loss(problem)
        return
    assert made.value == twin_fit.fit(problem).rollout_loss


def test_hopeless_trials_are_pruned_before_their_last_epoch(folder, monkeypatch):
    monkeypatch.setattr(twin_fit, "ROLLOUT_EVERY", 1)
    monkeypatch.setattr(worker, "pruner_of", lambda scenarios: worker.MedianPruner(n_startup_trials=1, n_warmup_steps=0))
    space = {"simulation.gravity": {"choices": [9.8, 80.0]}, "fit.learning_rate": {"choices": [1e-4, 1.1e-4]}}
    made = work(folder, sweep(trials=5, space=space))
    heavy = [one for one in made if one.params["simulation.gravity"] == 80.0]
    assert heavy
    assert all(one.state == TrialState.PRUNED and list(one.intermediate_values) == [0] for one in heavy)


def test_a_failure_is_a_failed_trial_with_its_reason(folder):
    tune = sweep(trials=3, space={"simulation.safety": {"choices": [0.8, 1e-6]}})
    made = work(folder, tune)
    failed = [one for one in made if one.state == TrialState.FAIL]
    assert failed and len(made) == 3
    assert all("search: none of 11 candidates could be simulated" in one.user_attrs["reason"] for one in failed)
    report(settings(), tune, folder / "summary.md", folder.parent)
    assert f"{len(failed)} failed" in (folder / "summary.md").read_text()


def test_a_trial_of_a_killed_worker_is_run_again_with_its_values(folder, monkeypatch):
    tune = sweep(workers=2)
    monkeypatch.setattr(worker, "HEARTBEAT", 1)
    scene = trial.TrainingScene.of(folder.parent / "observations.npz", folder / "frames")
    plan = Plan.of(settings(), tune, folder.parent)
    study = worker.study_of(folder, tune, plan.facts() | {"frames": {"small": scene.digest}}, begin=True)
    study.enqueue_trial({"fit.learning_rate": 2e-3, "fit.horizon": 2})
    left = study.ask()
    for name in tune.space:
        trial.suggest(left, name, plan)
    study._storage.record_heartbeat(left._trial_id)
    time.sleep(3)
    made = work(folder, tune, number=1)
    assert made[0].state == TrialState.FAIL
    assert made[0].params in [one.params for one in made if one.state == TrialState.COMPLETE]
    assert len(made) == tune.trials
