"""A finished sweep: its trials, records, summary and overlay."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.experiments import benchmark
from neuspring.extensions.tuning.report import state
from tests.extensions.tuning.sweeps import BASE, report, settings, sweep, trials, work


def test_trial_0_is_the_unchanged_configuration_and_all_values_lie_in_the_space(finished):
    folder, tune = finished
    by_number = trials(folder, tune)
    assert list(by_number) == [0, 1, 2, 3]
    assert [state(one) for one in by_number.values()] == ["complete"] * 4
    assert by_number[0].params == {"fit.learning_rate": 1e-4, "fit.horizon": 1, "fit.damping": "fixed"}
    rates = [one.params["fit.learning_rate"] for one in by_number.values()]
    assert all(1e-4 <= rate <= 1e-1 for rate in rates)
    assert len(set(rates)) == 4


def test_a_finished_sweep_leaves_no_checkpoints_and_is_not_run_again(finished):
    folder, tune = finished
    assert not list(folder.rglob("*.partial.npz"))
    (search,) = folder.glob("search-*/search.json")
    assert json.loads(search.read_text())["attempts"] == 1, "trials that vary the fit alone share one search"
    assert work(folder, tune) == []


def test_the_summary_counts_and_compares_with_the_baseline(finished):
    folder, tune = finished
    text, table = (folder / "summary.md").read_text(), pd.read_csv(folder / "trials.csv")
    values = {number: one.value for number, one in trials(folder, tune).items()}
    best = min(values, key=values.get)
    assert "4 of 4 trials: 4 finished, 0 pruned, 0 failed." in text
    assert f"Trial {best}: {values[best]:.4e} m²." in text
    assert best != 0, "the sweep begins at a rate that it can improve, so that there is something to compare"
    assert f"(trial 0): {values[0]:.4e} m²" in text
    assert table["loss"].tolist() == list(values.values())
    assert np.allclose(table["loss/small"], table["loss"])


def test_the_best_overlay_makes_the_best_trial_a_method_row(finished):
    folder, tune = finished
    values = BASE | {"scenarios": ["toy_rope_lift_smooth"], "methods": ["search_only"]}
    config.merge(values, config.read_yaml(folder / "best.yaml"))
    bench = benchmark.Benchmark(values, Path(__file__).parents[3])
    best = min(trials(folder, tune).values(), key=lambda one: one.value)
    tuned = benchmark.with_method(bench.config, bench.methods["baseline_small"], "baseline_small").fit
    assert list(bench.methods) == ["baseline", "baseline_small"]
    assert (tuned.learning_rate, tuned.horizon, tuned.damping) == tuple(best.params[f"fit.{n}"] for n in NAMES)
    assert benchmark.with_method(bench.config, bench.methods["baseline"], "baseline").fit == settings().fit


NAMES = ("learning_rate", "horizon", "damping")


def test_varied_search_settings_and_clusters_get_a_search_row(folder):
    space = {"clusters": {"low": 2, "high": 3}, "search.polish": {"choices": [0, 1]}}
    tune = sweep(method="search_only", trials=2, space=space | {"simulation.gravity": {"choices": [9.8, 9.7]}})
    work(folder, tune)
    report(folder, tune)
    assert len(list(folder.glob("search-*/search.json"))) == 2
    values = min(trials(folder, tune).values(), key=lambda one: one.value).user_attrs["values"]
    row = config.read_yaml(folder / "searches.yaml")["search_only_small"]
    assert row["clusters"] == values["clusters"]
    assert row["settings"] == {"polish": values["search.polish"]}
    assert config.read_yaml(folder / "methods.yaml")["search_only_small"]["search"] == "search_only_small"
    assert config.read_yaml(folder / "best.yaml")["simulation"] == {"gravity": values["simulation.gravity"]}
    # The baseline has one region and six rounds, which the space cannot hold: it is trial 0 all the same.
    first = trials(folder, tune)[0]
    assert first.user_attrs["values"] == {"clusters": 1, "search.polish": 6, "simulation.gravity": 9.8}
    assert first.params == {"simulation.gravity": 9.8}
