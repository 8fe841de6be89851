"""Tuning: exact counts over workers and kills, held-back frames, pruning, what is refused, and what a study leaves behind."""

import dataclasses
import json
import multiprocessing
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from neuspring import config
from neuspring.config.tuning import Tune
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.experiments import benchmark
from neuspring.experiments.tracking.payload import RunRecord, payload
from neuspring.experiments.tuning import report as tune_report
from neuspring.experiments.tuning import store as tune_store
from neuspring.experiments.tuning import trial as tune_trial
from neuspring.experiments.tuning import worker as tune
from neuspring.experiments.tuning.space import Plan
from neuspring.experiments.tuning.store import FileLocks, Store
from neuspring.stages import stages
from neuspring.twin.field import SpringField, adaptive_resolution
from neuspring.twin.fit import FitProblem, TwinFit, fit
from tests.support import small, stores

START = {"object_radius": 0.045, "stiffness": 1.0e4}
BASE = {"scenarios": ["small"], "search": {"rollouts": 11, "start": START}, "fit": {"epochs": 3, "checkpoint_every": 1}}
METHODS = {
    "search_only": {"search": "uniform", "fit": None, "description": "No second stage"},
    "baseline": {"search": "uniform", "fit": "springs", "description": "Springs"},
    "field": {"search": "uniform", "fit": "field", "description": "Field", "settings": {"horizon": 3}},
}
SEARCHES = {"uniform": {"clusters": 1, "description": "One region"}}
FAST = {"fit.learning_rate": {"low": 1.0e-4, "high": 1.0e-1, "log": True}, "fit.horizon": {"choices": [1, 2]}}
"""Settings of the fit alone, so that one search serves all trials."""


def settings(**changes) -> config.Config:
    values = json.loads(json.dumps(BASE))
    config.merge(values, changes)
    return config.parse(config.Config, values, "test")


def study(**changes) -> Tune:
    base = {"study": "small", "method": "baseline", "trials": 3, "startup_trials": 2, "warmup_epochs": 1, "space": FAST}
    return config.parse(Tune, base | changes, "tune")


def furnish(root: Path, observations: Observations | None = None) -> Path:
    """Put the tables and observations that a study reads into a folder; returns the place of the study's own folder in it."""
    for name, rows in {"methods": METHODS, "searches": SEARCHES}.items():
        path = root / "config" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(rows))
    (observations or small.observations()).save(root / SEEN)
    return root / "study"


SEEN = "observations.npz"


@pytest.fixture
def folder(tmp_path) -> Path:
    return furnish(tmp_path)


def plan(folder: Path, chosen: Tune, base: config.Config | None = None) -> Plan:
    return Plan.of(base or settings(), chosen, folder.parent)


def work(folder: Path, chosen: Tune, worker: int = 0, base: config.Config | None = None, after=lambda: None) -> list[int]:
    """Run a worker, `after` each of its trials; returns the slots that it ran."""
    ended: list[int] = []
    tune.work(
        base or settings(),
        chosen,
        [folder.parent / SEEN],
        worker,
        "cpu",
        folder / f"worker-{worker}.json",
        folder.parent,
        lambda slot, text: (ended.append(slot), after()),
    )
    return ended


def report(folder: Path, chosen: Tune, base: config.Config | None = None) -> str:
    tune_report.report(base or settings(), chosen, folder / "summary.md", folder.parent)
    return (folder / "summary.md").read_text()


def slots(folder: Path, chosen: Tune, base: config.Config | None = None) -> dict[int, tune_store.Slot]:
    return tune_store.slots(Store(folder, chosen.storage, chosen.study).load(plan(folder, chosen, base).facts()))


def found(folder: Path, chosen: Tune) -> list[tuple]:
    """State, value, values and intermediate losses of every slot."""
    return [
        (slot.state, slot.trials[-1].value, slot.trials[-1].user_attrs.get("values"), slot.trials[-1].intermediate_values)
        for slot in slots(folder, chosen).values()
    ]


# One study --------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A study of four trials, reported."""
    folder = furnish(tmp_path_factory.mktemp("tune"))
    chosen = study(trials=4, pruner="none", space=FAST | {"fit.schedule": {"choices": ["constant", "cosine"]}})
    work(folder, chosen)
    report(folder, chosen)
    return folder, chosen


def test_trial_0_is_the_unchanged_configuration_and_all_values_lie_in_the_space(finished):
    folder, chosen = finished
    by_slot = slots(folder, chosen)
    assert list(by_slot) == [0, 1, 2, 3]
    assert [slot.state for slot in by_slot.values()] == ["complete"] * 4
    assert by_slot[0].trials[-1].params == {"fit.learning_rate": 1e-3, "fit.horizon": 1, "fit.schedule": "constant"}
    rates = [slot.trials[-1].params["fit.learning_rate"] for slot in by_slot.values()]
    assert all(1e-4 <= rate <= 1e-1 for rate in rates)
    assert len(set(rates)) == 4


def test_trials_that_vary_the_fit_alone_share_one_search(finished):
    folder, _ = finished
    searches = list(folder.glob("search-*/search.json"))
    assert len(searches) == 1
    assert json.loads(searches[0].read_text())["attempts"] == 1


def test_a_finished_study_leaves_no_checkpoints_and_is_not_run_again(finished):
    folder, chosen = finished
    assert not list(folder.rglob("*.partial.npz"))
    assert work(folder, chosen) == []


def test_every_trial_and_the_study_are_run_records_that_tracking_accepts(finished):
    folder, chosen = finished
    records = {path: RunRecord.load(path) for path in folder.rglob("run.json")}
    assert len(records) == 5
    # Runs of the same name would supersede each other.
    assert len({record.name for record in records.values()}) == 5
    assert {record.method for record in records.values()} == {"tune-small"}
    by_slot = slots(folder, chosen)
    for path, record in records.items():
        sent = payload(record, path, folder)
        values = {point.name: point.value for point in sent.metrics}
        if record.scenario == "study":
            assert values["tail.best"] == min(slot.trials[-1].value for slot in by_slot.values())
            assert {file.name for file, _ in sent.files} >= {"history.png", "slices.png", "summary.md", "best.yaml"}
        else:
            trial = by_slot[int(path.parent.name)].trials[-1]
            assert values["tail.loss"] == trial.value
            assert values["steps.tail_loss"] == trial.intermediate_values[max(trial.intermediate_values)]
            assert record.params["fit.learning_rate"] == trial.params["fit.learning_rate"]


def test_a_record_that_a_killed_worker_did_not_write_is_made_by_the_report(finished):
    folder, chosen = finished
    path = folder / "trials" / "2" / "run.json"
    before = json.loads(path.read_text())
    shutil.rmtree(path.parent)
    report(folder, chosen)
    assert json.loads(path.read_text()) == before


def test_the_summary_counts_and_compares_with_the_baseline(finished):
    folder, chosen = finished
    text, table = (folder / "summary.md").read_text(), pd.read_csv(folder / "trials.csv")
    values = {number: slot.trials[-1].value for number, slot in slots(folder, chosen).items()}
    best = min(values, key=values.get)
    assert "4 of 4 trials: 4 finished, 0 pruned, 0 failed." in text
    assert f"Trial {best}: {values[best]:.4e} m²." in text
    assert f"(trial 0): {values[0]:.4e} m²" in text
    assert table["loss"].tolist() == list(values.values())
    assert np.allclose(table["loss/small"], table["loss"])
    assert all((folder / name).is_file() for name in tune_report.PICTURES if name in text)


def test_the_best_overlay_makes_the_best_trial_a_method_row(finished):
    folder, chosen = finished
    values = BASE | {"scenarios": ["toy_rope_lift_smooth"], "methods": ["search_only"]}
    config.merge(values, config.read_yaml(folder / "best.yaml"))
    bench = benchmark.Benchmark.of(values, Path(__file__).parents[2])
    by_slot = slots(folder, chosen)
    best = min(by_slot.values(), key=lambda slot: slot.trials[-1].value).trials[-1]
    tuned = benchmark.fit_of(bench.config, bench.methods["baseline_small"], "baseline_small")
    assert list(bench.methods) == ["baseline", "baseline_small"]
    assert (tuned.learning_rate, tuned.horizon, tuned.schedule) == tuple(best.params[f"fit.{n}"] for n in NAMES)
    assert benchmark.fit_of(bench.config, bench.methods["baseline"], "baseline") == settings().fit


NAMES = ("learning_rate", "horizon", "schedule")


def test_varied_search_settings_and_clusters_get_a_search_row(folder):
    space = {"clusters": {"low": 2, "high": 3}, "search.sigma": {"choices": [0.1, 0.3]}}
    chosen = study(method="search_only", trials=2, space=space | {"simulation.gravity": {"choices": [9.8, 9.7]}})
    work(folder, chosen)
    report(folder, chosen)
    assert len(list(folder.glob("search-*/search.json"))) == 2
    best = min(slots(folder, chosen).values(), key=lambda slot: slot.trials[-1].value)
    values = best.trials[-1].user_attrs["values"]
    row = config.read_yaml(folder / "searches.yaml")["search_only_small"]
    assert row["clusters"] == values["clusters"]
    assert row["settings"] == {"sigma": values["search.sigma"]}
    assert config.read_yaml(folder / "methods.yaml")["search_only_small"]["search"] == "search_only_small"
    assert config.read_yaml(folder / "best.yaml")["simulation"] == {"gravity": values["simulation.gravity"]}
    # The baseline has one region and sigma 1/6, which the space cannot hold: it is trial 0 all the same.
    first = slots(folder, chosen)[0].trials[-1]
    assert first.user_attrs["values"] == {"clusters": 1, "search.sigma": 1 / 6, "simulation.gravity": 9.8}
    assert first.params == {"simulation.gravity": 9.8}


# What trials may see -----------------------------------------------------------------------------------------------------------


def test_no_test_frame_changes_any_trial(tmp_path, finished):
    folder, chosen = finished
    spoiled = furnish(tmp_path, small.spoiled_future())
    assert not np.array_equal(small.spoiled_future().object_points, small.observations().object_points)
    work(spoiled, chosen)
    assert found(spoiled, chosen) == found(folder, chosen)


def test_the_search_does_not_see_the_held_back_tail(tmp_path):
    scene = small.observations()
    end = tune_trial.head_end(scene.scenario.train_end, 0.4)
    points = scene.object_points.copy()
    points[end:] += 1.0
    heads = []
    for name, observations in {"as": scene, "changed": dataclasses.replace(scene, object_points=points)}.items():
        observations.save(tmp_path / f"{name}.npz")
        made = tune_trial.Scene.of(tmp_path / f"{name}.npz", 0.4, tmp_path / name)
        heads.append(made.head.read_bytes())
        assert len(Observations.load(made.head).object_points) == end < scene.scenario.train_end
        assert len(made.training.object_points) == scene.scenario.train_end < scene.scenario.frame_count
    assert heads[0] == heads[1]


@pytest.mark.parametrize("fraction", [0.01, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("frames", [8, 20])
def test_the_tail_is_the_one_that_the_fit_holds_back(fraction, frames):
    problem = small.fit_problem(small.scene(frames=frames).observations)
    held = TwinFit(dataclasses.replace(problem, fit=config.Fit(selection="tail", tail_fraction=fraction))).head_end
    assert tune_trial.head_end(problem.observations.scenario.train_end, fraction) == held


@pytest.mark.parametrize(("method", "selection"), [("baseline", "training_loss"), ("baseline", "tail"), ("search_only", "tail")])
def test_a_trial_is_judged_by_the_twin_that_the_method_would_choose(folder, method, selection):
    base = settings(fit={"selection": selection, "learning_rate": 0.3, "tail_fraction": 0.4, "epochs": 4})
    chosen = study(method=method, trials=1, space={"losses.acceleration": {"choices": [0.01, 0.02]}})
    work(folder, chosen, base=base)
    value = slots(folder, chosen, base)[0].trials[-1].value
    record = next(folder.glob("search-*/search.json"))
    twin = Twin.load(StageRecord.load(record).file("twin", record))
    training = tune_trial.cut(small.observations(), small.observations().scenario.train_end)
    tailed = dataclasses.replace(base.fit, selection="tail")
    problem = FitProblem(training, twin, tailed, base.simulation, base.losses, base.released_quirks)
    if method == "search_only":
        assert value == TwinFit(problem).tail_loss()
        return
    result = fit(problem)
    by_training = result.history["tail_loss"][result.history["loss"].argmin()]
    assert value == (result.best_loss if selection == "tail" else by_training)
    assert result.best_loss != by_training, "the two rules choose different twins, or this test could not tell them apart"


# How trials end ---------------------------------------------------------------------------------------------------------------


def test_hopeless_trials_are_pruned_before_their_last_epoch(folder):
    space = {"simulation.gravity": {"choices": [9.8, 80.0]}, "fit.learning_rate": {"choices": [1e-3, 1.1e-3]}}
    chosen = study(trials=5, startup_trials=1, warmup_epochs=0, space=space)
    work(folder, chosen)
    heavy = [slot for slot in slots(folder, chosen).values() if slot.trials[-1].params["simulation.gravity"] == 80.0]
    assert heavy
    for slot in heavy:
        assert slot.state == "pruned"
        assert slot.reason.startswith("small, epoch 0: ")
        assert list(slot.trials[-1].intermediate_values) == [0]


def test_losses_of_other_scenarios_do_not_keep_a_trial():
    """A median of best values over all steps would compare the second scenario with the first."""
    import optuna

    made = optuna.create_study(pruner=tune.MedianOfStep(study(startup_trials=1), 0))
    for losses in ([1e-5, 1e-3], [1e-5, 1e-3]):
        trial = made.ask()
        for step, loss in enumerate(losses):
            trial.report(loss, step)
        made.tell(trial, losses[-1])
    trial = made.ask()
    trial.report(0.9e-5, 0)
    assert not trial.should_prune()
    trial.report(1e-2, 1)
    assert trial.should_prune()


def test_pruning_waits_for_whole_scenarios():
    for scenarios, steps in ((1, 5), (2, 15), (22, 85)):
        pruner = tune.pruner_of(study(warmup_epochs=5), scenarios, 10)
        assert pruner._inner._n_warmup_steps == steps
    assert tune.pruner_of(study(warmup_epochs=5, warmup_scenarios=0), 22, 10)._inner._n_warmup_steps == 5


def test_a_numerical_failure_is_a_failed_trial_with_its_reason(folder):
    chosen = study(trials=3, space={"simulation.max_substeps": {"choices": [2000, 1]}})
    work(folder, chosen)
    by_slot = slots(folder, chosen)
    failed = [slot for slot in by_slot.values() if slot.state == "failed"]
    assert len(by_slot) == 3
    assert failed
    assert all("search: none of 11 candidates could be simulated" in slot.reason for slot in failed)
    assert all(slot.trials[-1].user_attrs["values"] == {"simulation.max_substeps": 1} for slot in failed)
    report(folder, chosen)
    assert f"{len(failed)} failed" in (folder / "summary.md").read_text()


def test_a_trial_that_keeps_ending_its_worker_is_given_up(folder, monkeypatch):
    chosen, crashes = study(trials=2), 0

    def crashing(*_args, **_kwargs):
        nonlocal crashes
        crashes += 1
        raise MemoryError("no room")

    monkeypatch.setattr(tune_store, "MOST_DEATHS", 2)
    with monkeypatch.context() as patch:
        patch.setattr(tune_trial, "fit", crashing)
        for _ in range(2):
            with pytest.raises(MemoryError):
                work(folder, chosen)
    assert crashes == 2
    assert work(folder, chosen) == [1]
    by_slot = slots(folder, chosen)
    assert [slot.state for slot in by_slot.values()] == ["failed", "complete"]
    assert by_slot[0].reason == "given up after 2 attempts, the last: MemoryError: no room"


# Kills, resumption, workers ----------------------------------------------------------------------------------------------------


def test_more_trials_continue_a_study(folder):
    assert work(folder, study(trials=2)) == [0, 1]
    assert work(folder, study(trials=3)) == [2]
    assert list(slots(folder, study())) == [0, 1, 2]


def test_a_killed_and_continued_study_finds_what_one_in_a_single_go_finds(tmp_path, finished, monkeypatch):
    whole, chosen = finished
    folder = furnish(tmp_path)
    epochs, run_epoch = 0, TwinFit.epoch

    def dying(self):
        nonlocal epochs
        epochs += 1
        # In the last of three epochs of the third trial.
        if epochs == 9:
            raise KeyboardInterrupt
        return run_epoch(self)

    monkeypatch.setattr(TwinFit, "epoch", dying)
    with pytest.raises(KeyboardInterrupt):
        work(folder, chosen)
    assert [slot.state for slot in slots(folder, chosen).values()] == ["complete", "complete", "running"]
    assert work(folder, chosen) == [2, 3]
    assert found(folder, chosen) == found(whole, chosen)
    assert epochs == 4 * 3 + 1, "two epochs of the third trial were not repeated"


def test_a_kill_between_asking_for_a_trial_and_taking_it_costs_nothing(folder, monkeypatch):
    import optuna

    chosen, ask = study(trials=2), optuna.Study.ask

    def killed(*_args, **_kwargs):
        raise KeyboardInterrupt

    def asked_and_killed(self):
        ask(self)
        raise KeyboardInterrupt

    for stand_in in (killed, asked_and_killed):
        with monkeypatch.context() as patch:
            patch.setattr(optuna.Study, "ask", stand_in)
            with pytest.raises(KeyboardInterrupt):
                work(folder, chosen)
    assert work(folder, chosen) == [0, 1]
    assert [len(slot.trials) for slot in slots(folder, chosen).values()] == [2, 1]


def counting(calls: Path) -> None:
    """Note every search in a file, in this process."""
    searched = stages.search

    def noted(*args, **kwargs):
        with calls.open("a") as stream:
            stream.write("search\n")
        searched(*args, **kwargs)

    stages.search = noted


def other_worker(folder: Path, chosen: Tune, start, hangs, calls: Path) -> None:
    """Worker 1 in a process of its own, which hangs in the first epoch of its second trial."""
    counting(calls)
    epochs, run_epoch = 0, TwinFit.epoch

    def epoch(self):
        nonlocal epochs
        epochs += 1
        if epochs > 3:
            hangs.set()
            multiprocessing.Event().wait()
        return run_epoch(self)

    TwinFit.epoch = epoch
    start.wait(120)
    work(folder, chosen, 1)


def two_workers(folder: Path, chosen: Tune) -> None:
    """Two workers begin a study of six trials together; one is killed in its second trial, the other goes on."""
    calls, processes = folder.parent / "calls", multiprocessing.get_context("spawn")
    start, hangs = processes.Barrier(2), processes.Event()
    other = processes.Process(target=other_worker, args=(folder, chosen, start, hangs, calls))
    other.start()
    try:
        counting(calls)
        start.wait(120)
        mine = work(folder, chosen, after=lambda: hangs.wait(120))
        states = {number: slot.state for number, slot in slots(folder, chosen).items()}
        held = [number for number, state in states.items() if state == "running"]
        assert len(states) == 6
        assert len(mine) == 4
        assert len(held) == 1, "what a living worker runs is left alone"
    finally:
        other.kill()
        other.join()
    assert work(folder, chosen) == held
    by_slot = slots(folder, chosen)
    assert [slot.state in ("complete", "pruned") for slot in by_slot.values()] == [True] * 6
    assert {number: len(slot.trials) for number, slot in by_slot.items() if number in held} == {held[0]: 2}
    assert sum(len(slot.trials) for slot in by_slot.values()) == 7
    assert calls.read_text() == "search\n", "workers that need the same search make it once"


def test_two_workers_and_a_kill_make_exactly_the_trials_asked_for(folder, monkeypatch):
    # Restored after the test.
    monkeypatch.setattr(stages, "search", stages.search)
    two_workers(folder, study(trials=6, workers=2, pruner="none"))


@pytest.mark.slow
@pytest.mark.skipif(bool(stores.without_postgres()), reason=stores.without_postgres())
def test_postgresql_holds_a_study(folder, monkeypatch):
    monkeypatch.setattr(stages, "search", stages.search)
    with stores.postgres() as cluster:
        chosen = study(trials=6, workers=2, pruner="none", storage=cluster.database("study"))
        two_workers(folder, chosen)
        assert "6 of 6 trials" in report(folder, chosen)
    assert not (folder / tune_store.DATABASE).exists()


def test_a_lock_is_free_when_nobody_holds_it(tmp_path):
    locks = FileLocks(tmp_path)
    assert locks.is_free("worker-0")
    with locks.hold("worker-0"):
        assert not locks.is_free("worker-0")
        assert locks.is_free("worker-1")
    assert locks.is_free("worker-0")


# What is refused --------------------------------------------------------------------------------------------------------------

RANGE = {"low": 1, "high": 2}


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"fit.learning_rat": RANGE}, ["tune.space, fit.learning_rat", "Did you mean learning_rate?"]),
        ({"fitt.horizon": RANGE}, ["must begin with simulation", "Did you mean fit?"]),
        ({"toy.frames": RANGE}, ["must begin with simulation"]),
        ({"fit.field": RANGE}, ["not a section"]),
        ({"search.clusters": RANGE}, ["not a section", "called clusters"]),
        ({"fit.horizon.more": RANGE}, ["more must be a setting"]),
        ({"fit.horizon": {"low": 1.0, "high": 2.0}}, ["fit.horizon, low", "whole number"]),
        ({"clusters": {"low": 1, "high": 2.5}}, ["clusters, high", "whole number"]),
        ({"clusters": {"low": 0, "high": 2}}, ["clusters", "at least 1"]),
        ({"fit.schedule": RANGE}, ["choices are required"]),
        ({"fit.schedule": {"choices": ["constant", "linear"]}}, ["fit.schedule = 'linear'", "constant", "cosine"]),
        ({"fit.learning_rate": {"low": -1.0, "high": 1.0}}, ["fit.learning_rate = -1.0", "greater than 0"]),
        ({"fit.field.channels": RANGE}, ["trains springs"]),
        ({"fit.selection": {"choices": ["tail", "training_loss"]}}, ["same in all trials"]),
        ({"losses.chamfer": RANGE}, ["same in all trials"]),
        ({"search.tied_rollouts": {"low": 0, "high": 11}}, ["search.tied_rollouts = 11", "below rollouts"]),
        ({"fit.stiffness_range": {"choices": [[0.0, 1e5], [0.0, 1e4]]}}, ["must hold search.ranges.stiffness"]),
        (
            {"search.tied_rollouts": {"low": 0, "high": 8}, "search.rollouts": {"low": 5, "high": 11}},
            ["search.tied_rollouts = 8, search.rollouts = 5", "below rollouts"],
        ),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_space_that_cannot_be_is_refused_by_name(finished, space, words):
    with pytest.raises(InputError) as error:
        plan(finished[0], study(space=space))
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("dimension", "words"),
    [
        ({"low": 1}, "low and high, or choices"),
        ({"low": 2, "high": 1}, "low < high"),
        ({"low": 0, "high": 1, "log": True}, "log"),
        ({"low": 0, "high": 1, "step": 2}, "step"),
        ({"choices": [1]}, "at least two"),
        ({"choices": [1, 2], "low": 1}, "either"),
        ({"low": "1e-4", "high": 1}, "5.0e-5"),
        ({"lowest": 1, "high": 2}, "unknown key"),
    ],
    ids=str,
)
def test_a_dimension_that_cannot_be_is_refused(dimension, words):
    with pytest.raises(InputError, match=words):
        study(space={"fit.horizon": dimension})


def test_a_password_in_the_storage_is_refused():
    with pytest.raises(InputError, match="a password would be shown"):
        study(storage="postgresql://me:secret@host:5432/studies")
    assert study(storage="postgresql://me@host:5432/studies").storage


def test_a_method_without_a_first_order_stage_has_no_fit_settings_to_vary(finished):
    with pytest.raises(InputError, match="no first-order stage"):
        plan(finished[0], study(method="search_only"))


def test_an_unknown_method_is_refused(finished):
    with pytest.raises(InputError, match=r"Did you mean baseline\?"):
        plan(finished[0], study(method="basline"))


def test_a_study_does_not_go_on_with_other_settings(finished):
    folder, chosen = finished
    other, space = settings(fit={"epochs": 4}), chosen.space | study(space={"fit.horizon": {"choices": [1, 3]}}).space
    with pytest.raises(InputError, match=r"another base\.fit\.epochs"):
        work(folder, chosen, base=other)
    with pytest.raises(InputError, match=r"another base\.fit\.epochs"):
        report(folder, chosen, other)
    with pytest.raises(InputError, match=r"another space\.fit\.horizon\.choices"):
        work(folder, dataclasses.replace(chosen, space=space))


def test_a_study_that_was_not_begun_has_no_report(folder):
    with pytest.raises(InputError, match="must have been begun"):
        report(folder, study())


def test_observations_of_other_scenarios_and_workers_without_a_number_are_refused(folder):
    with pytest.raises(InputError, match="those of other are required"):
        work(folder, study(scenarios=["other"]))
    with pytest.raises(InputError, match=r"0 to tune\.workers - 1 = 0"):
        work(folder, study(), 1)


def test_settings_that_exclude_each_other_only_inside_their_ranges_fail_the_trial(folder, monkeypatch):
    allowed = Plan.at

    def at(self, values, where):
        if where.startswith("trial"):
            raise InputError(where, "these settings exclude each other")
        return allowed(self, values, where)

    monkeypatch.setattr(Plan, "at", at)
    work(folder, study(trials=2))
    reasons = [slot.reason for slot in slots(folder, study()).values()]
    assert reasons == [f"trial {number}: these settings exclude each other." for number in (0, 1)]
    assert "2 of 3 trials: 0 finished, 0 pruned, 2 failed." in report(folder, study())


def test_a_plan_is_made_without_heavy_imports():
    heavy = ("torch", "warp", "mlflow", "matplotlib", "optuna")
    code = f"import sys, neuspring.experiments.tuning.space; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


# The field's resolution -------------------------------------------------------------------------------------------------------


def test_a_factor_varies_the_adaptive_resolution():
    points = np.random.default_rng(0).random((400, 3))
    assert SpringField(points, config.SpringField(), 1, 0).resolution == adaptive_resolution(400) == 17
    assert SpringField(points, config.SpringField(adaptive_factor=1.7), 1, 0).resolution == 34
    assert SpringField(points, config.SpringField(adaptive_factor=1.7, resolution=9), 1, 0).resolution == 9
