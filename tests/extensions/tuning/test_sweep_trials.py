"""Trials of a sweep: what they may see, how they are judged, how they end."""

import dataclasses

import numpy as np
import pytest

from neuspring.core.artifacts import Observations, Twin
from neuspring.core.records import StageRecord
from neuspring.extensions.tuning import trial, worker
from neuspring.extensions.tuning.report import state
from neuspring.twin import fit as twin_fit
from neuspring.twin.fit import FitProblem, TwinFit, fit, tail_start
from tests.extensions.tuning.sweeps import furnish, report, results_of, settings, sweep, trials, work
from tests.support import small


def test_no_test_frame_changes_any_trial(tmp_path, finished):
    folder, tune = finished
    spoiled = furnish(tmp_path, small.spoiled_future())
    assert not np.array_equal(small.spoiled_future().object_points, small.observations().object_points)
    work(spoiled, tune)
    assert results_of(spoiled, tune) == results_of(folder, tune)


def test_the_search_does_not_see_the_tail(tmp_path, monkeypatch):
    monkeypatch.setattr(twin_fit, "TAIL_FRACTION", 0.4)
    scene = small.observations()
    end = tail_start(scene.scenario.train_end)
    points = scene.object_points.copy()
    points[end:] += 1.0
    heads = []
    for name, observations in {"as": scene, "changed": dataclasses.replace(scene, object_points=points)}.items():
        observations.save(tmp_path / f"{name}.npz")
        made = trial.TrainingScene.of(tmp_path / f"{name}.npz", tmp_path / name)
        heads.append(made.head.read_bytes())
        assert len(Observations.load(made.head).object_points) == end < scene.scenario.train_end
        assert len(made.training.object_points) == scene.scenario.train_end < scene.scenario.frame_count
    assert heads[0] == heads[1]


@pytest.mark.parametrize(("method", "selection"), [("baseline", "training_loss"), ("baseline", "tail"), ("search_only", "tail")])
def test_a_trial_is_judged_by_the_twin_that_the_method_would_choose(folder, method, selection, monkeypatch):
    monkeypatch.setattr(twin_fit, "TAIL_FRACTION", 0.4)
    base = settings(fit={"selection": selection, "learning_rate": 2.0, "epochs": 8})
    tune = sweep(method=method, trials=1, space={"losses.acceleration": {"choices": [0.01, 0.02]}})
    work(folder, tune, base=base)
    value = trials(folder, tune, base)[0].value
    record = next(folder.glob("search-*/search.json"))
    twin = Twin.load(StageRecord.load(record).file("twin", record))
    training = trial.cut(small.observations(), small.observations().scenario.train_end)
    tailed = dataclasses.replace(base.fit, selection="tail")
    problem = FitProblem(
        observations=training, twin=twin, fit=tailed, simulation=base.simulation, losses=base.losses, quirks=base.released_quirks
    )
    if method == "search_only":
        assert value == TwinFit(problem).tail_loss()
        return
    result = fit(problem)
    by_training = result.history["tail_loss"][result.history["loss"].argmin()]
    assert value == (result.facts["best_loss"] if selection == "tail" else by_training)
    assert result.facts["best_loss"] != by_training, "the two rules choose different twins, or this test could not tell them apart"


def test_hopeless_trials_are_pruned_before_their_last_epoch(folder, monkeypatch):
    monkeypatch.setattr(worker, "STARTUP_TRIALS", 1)
    monkeypatch.setattr(worker, "WARMUP_EPOCHS", 0)
    space = {"simulation.gravity": {"choices": [9.8, 80.0]}, "fit.learning_rate": {"choices": [1e-3, 1.1e-3]}}
    tune = sweep(trials=5, space=space)
    work(folder, tune)
    heavy = [one for one in trials(folder, tune).values() if one.params["simulation.gravity"] == 80.0]
    assert heavy
    for one in heavy:
        assert state(one) == "pruned"
        assert one.user_attrs[worker.REASON].startswith("small, epoch 0: ")
        assert list(one.intermediate_values) == [0]


def test_losses_of_other_scenarios_do_not_keep_a_trial(monkeypatch):
    """A median of best values over all steps would compare the second scenario with the first."""
    import optuna

    monkeypatch.setattr(worker, "STARTUP_TRIALS", 1)
    study = optuna.create_study(pruner=worker.MedianOfStep(0))
    for losses in ([1e-5, 1e-3], [1e-5, 1e-3]):
        trial = study.ask()
        for step, loss in enumerate(losses):
            trial.report(loss, step)
        study.tell(trial, losses[-1])
    trial = study.ask()
    trial.report(0.9e-5, 0)
    assert not trial.should_prune()
    trial.report(1e-2, 1)
    assert trial.should_prune()


def test_pruning_waits_for_whole_scenarios():
    for scenarios, steps in ((1, 5), (2, 15), (22, 85)):
        assert worker.pruner_of(scenarios, 10)._inner._n_warmup_steps == steps


def test_a_numerical_failure_is_a_failed_trial_with_its_reason(folder):
    tune = sweep(trials=3, space={"simulation.safety": {"choices": [0.8, 1e-6]}})
    work(folder, tune)
    by_number = trials(folder, tune)
    failed = [one for one in by_number.values() if state(one) == "failed"]
    assert len(by_number) == 3
    assert failed
    assert all("search: none of 11 candidates could be simulated" in one.user_attrs[worker.REASON] for one in failed)
    assert all(one.user_attrs["values"] == {"simulation.safety": 1e-6} for one in failed)
    report(folder, tune)
    assert f"{len(failed)} failed" in (folder / "summary.md").read_text()


def test_a_trial_that_keeps_ending_its_worker_is_replaced(folder, monkeypatch):
    tune, crashes = sweep(trials=2), 0

    def crashing(*_args, **_kwargs):
        nonlocal crashes
        crashes += 1
        raise MemoryError("no room")

    monkeypatch.setattr(worker, "MOST_DEATHS", 2)
    with monkeypatch.context() as patch:
        patch.setattr(trial, "fit", crashing)
        for _ in range(2):
            with pytest.raises(MemoryError):
                work(folder, tune)
    assert crashes == 2
    assert work(folder, tune) == [2, 3]
    assert [state(one) for one in trials(folder, tune).values()] == ["complete", "complete"]
