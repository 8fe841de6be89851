"""What a sweep refuses, and the field's resolution that it may vary."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from neuspring import config
from neuspring.config.settings import read_settings
from neuspring.config.tuning import Tune
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import Benchmark
from neuspring.extensions.tuning import jobs
from neuspring.extensions.tuning.space import Plan
from neuspring.twin.field import SpringField
from tests.extensions.tuning.sweeps import plan, report, settings, sweep, trials, work
from tests.support.project import config_with

ROOT = Path(__file__).parents[3]
RANGE = {"low": 1, "high": 2}


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"fit.learning_rat": RANGE}, ["tune.space, fit.learning_rat", "Did you mean learning_rate?"]),
        ({"fitt.horizon": RANGE}, ["must begin with simulation", "Did you mean fit?"]),
        ({"toy.frames": RANGE}, ["must begin with simulation"]),
        ({"fit.field": RANGE}, ["not a section"]),
        ({"fit.horizon.more": RANGE}, ["more must be a setting"]),
        ({"fit.horizon": {"low": 1.0, "high": 2.0}}, ["fit.horizon = 1.0", "valid integer"]),
        ({"clusters": {"low": 1, "high": 2.5}}, ["clusters", "whole number"]),
        ({"fit.epochs": {"low": 1, "high": 9, "step": 0.5}}, ["fit.epochs", "its step must be a whole number"]),
        ({"clusters": {"low": 0, "high": 2}}, ["clusters", "at least 1"]),
        ({"fit.damping": RANGE}, ["fit.damping = 1", "'fixed'"]),
        ({"fit.damping": {"choices": ["fixed", "springs"]}}, ["fit.damping = 'springs'", "fixed", "homogeneous"]),
        ({"fit.learning_rate": {"low": -1.0, "high": 1.0}}, ["fit.learning_rate = -1.0", "greater than 0"]),
        ({"fit.field.channels": RANGE}, ["trains springs"]),
        ({"fit.selection": {"choices": ["tail", "training_loss"]}}, ["same in all trials"]),
        ({"losses.chamfer": RANGE}, ["same in all trials"]),
        ({"search.tied_rollouts": {"low": 0, "high": 11}}, ["search.tied_rollouts = 11", "below rollouts"]),
        ({"fit.stiffness_range": {"choices": [[0.0, 1e5], [0.0, 1e4]]}}, ["must hold search.variables.stiffness"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_space_that_cannot_be_is_refused_by_name(finished, space, words):
    with pytest.raises(InputError) as error:
        plan(finished[0], sweep(space=space))
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
        sweep(space={"fit.horizon": dimension})


def test_a_password_in_the_storage_is_refused():
    with pytest.raises(InputError, match="a password would be shown"):
        sweep(storage="postgresql://me:secret@host:5432/studies")
    assert sweep(storage="postgresql://me@host:5432/studies").storage


def test_a_sweep_does_not_go_on_with_other_settings(finished):
    folder, tune = finished
    other, space = settings(fit={"epochs": 4}), tune.space | sweep(space={"fit.horizon": {"choices": [1, 3]}}).space
    with pytest.raises(InputError, match=r"another base\.fit\.epochs"):
        work(folder, tune, base=other)
    with pytest.raises(InputError, match=r"another base\.fit\.epochs"):
        report(folder, tune, other)
    with pytest.raises(InputError, match=r"another space\.fit\.horizon\.choices"):
        work(folder, dataclasses.replace(tune, space=space))


def test_settings_that_exclude_each_other_only_inside_their_ranges_fail_the_trial(folder, monkeypatch):
    allowed = Plan.at

    def at(self, values, where):
        if where.startswith("trial"):
            raise InputError(where, "these settings exclude each other")
        return allowed(self, values, where)

    monkeypatch.setattr(Plan, "at", at)
    work(folder, sweep(trials=2))
    reasons = [one.user_attrs["reason"] for one in trials(folder, sweep()).values()]
    assert reasons == [f"trial {number}: these settings exclude each other." for number in (0, 1)]
    assert "2 of 3 trials: 0 finished, 0 pruned, 2 failed." in report(folder, sweep())


def test_a_plan_is_made_without_heavy_imports():
    heavy = ("torch", "warp", "mlflow", "matplotlib", "optuna")
    code = f"import sys, neuspring.extensions.tuning.space; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_a_factor_varies_the_adaptive_resolution():
    points = np.random.default_rng(0).random((400, 3))
    chosen = [{}, {"adaptive_factor": 1.7}, {"adaptive_factor": 1.7, "resolution": 9}]
    assert [SpringField(points, config.SpringFieldSettings(**one), 1, 0).resolution for one in chosen] == [17, 34, 9]


def test_what_a_sweep_cannot_be_begun_with_is_refused(folder):
    for method, words in (("search_only", "no first-order stage"), ("basline", r"Did you mean baseline\?")):
        with pytest.raises(InputError, match=words):
            plan(folder, sweep(method=method))
    with pytest.raises(InputError, match="must have been begun"):
        report(folder, sweep())
    with pytest.raises(InputError, match="those of other are required"):
        work(folder, sweep(), base=settings(scenarios=["other"]))
    with pytest.raises(InputError, match=r"0 to tune\.workers - 1 = 0"):
        work(folder, sweep(), 1)


def test_no_sweep_chooses_by_an_oracle():
    values = {"study": "s", "method": "oracle_neuspring", "space": {"fit.learning_rate": {"low": 1e-4, "high": 1e-2}}}
    with pytest.raises(InputError, match="an oracle sees the future"):
        Plan.of(config.Config(), config.parse(Tune, values, "x"), ROOT)


@pytest.mark.parametrize("data", ["toy", "phystwin"])
def test_the_shipped_sweep_is_valid(data):
    values: dict = {}
    for name in ("config", f"data/{data}", "studies/tune"):
        config.merge(values, config.read_yaml(ROOT / "config" / f"{name}.yaml"))
    parsed = config.parse(config.Config, values, "shipped")
    assert Plan.of(parsed, parsed.tune, ROOT)


def test_a_worker_varies_the_method_that_the_workflow_planned():
    values = config_with({"clusters": 8, "tune": {"study": "s", "method": "neuspring", "space": {"fit.epochs": RANGE}}})
    made = Benchmark(values, ROOT)
    told = read_settings(jobs.settings(made))
    planned = Plan.of(made.config, made.config.tune, ROOT)
    assert planned.row.clusters == 8 and Plan.of(told, told.tune, ROOT) == planned


def test_workers_on_several_machines_need_a_database_that_locks_across_them():
    def check(cluster, **changes):
        values = {"study": "rate", "method": "baseline", "workers": 2, "space": {"fit.learning_rate": {"low": 1e-4, "high": 1e-2}}}
        jobs.check(Benchmark(config_with({"tune": values | changes}), ROOT), cluster=cluster)

    check(False)
    with pytest.raises(InputError, match="workers on several machines need storage"):
        check(True)
    check(True, storage="postgresql://me@host/studies")
    check(True, workers=1)
