"""A finished sweep: its trials, records, summary and overlay."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.core.run_record import RunRecord
from neuspring.experiments import benchmark
from neuspring.experiments.tracking.log import payload
from neuspring.experiments.tuning.report import PICTURES
from tests.support.sweeps import BASE, report, settings, slots, sweep, work


def test_trial_0_is_the_unchanged_configuration_and_all_values_lie_in_the_space(finished):
    folder, tune = finished
    by_slot = slots(folder, tune)
    assert list(by_slot) == [0, 1, 2, 3]
    assert [slot.state for slot in by_slot.values()] == ["complete"] * 4
    assert by_slot[0].trials[-1].params == {"fit.learning_rate": 1e-4, "fit.horizon": 1, "fit.damping": "fixed"}
    rates = [slot.trials[-1].params["fit.learning_rate"] for slot in by_slot.values()]
    assert all(1e-4 <= rate <= 1e-1 for rate in rates)
    assert len(set(rates)) == 4


def test_a_finished_sweep_leaves_no_checkpoints_and_is_not_run_again(finished):
    folder, tune = finished
    assert not list(folder.rglob("*.partial.npz"))
    (search,) = folder.glob("search-*/search.json")
    assert json.loads(search.read_text())["attempts"] == 1, "trials that vary the fit alone share one search"
    assert work(folder, tune) == []


def test_every_trial_and_the_sweep_are_run_records_that_tracking_accepts(finished):
    folder, tune = finished
    records = {path: RunRecord.load(path) for path in folder.rglob("run.json")}
    assert len(records) == 5
    # Runs of the same name would supersede each other.
    assert len({record.name for record in records.values()}) == 5
    assert {record.method for record in records.values()} == {"tune-small"}
    by_slot = slots(folder, tune)
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


def test_the_summary_counts_and_compares_with_the_baseline(finished):
    folder, tune = finished
    text, table = (folder / "summary.md").read_text(), pd.read_csv(folder / "trials.csv")
    values = {number: slot.trials[-1].value for number, slot in slots(folder, tune).items()}
    best = min(values, key=values.get)
    assert "4 of 4 trials: 4 finished, 0 pruned, 0 failed." in text
    assert f"Trial {best}: {values[best]:.4e} m²." in text
    assert best != 0, "the sweep begins at a rate that it can improve, so that there is something to compare"
    assert f"(trial 0): {values[0]:.4e} m²" in text
    assert table["loss"].tolist() == list(values.values())
    assert np.allclose(table["loss/small"], table["loss"])
    assert all((folder / name).is_file() for name in PICTURES if name in text)


def test_the_best_overlay_makes_the_best_trial_a_method_row(finished):
    folder, tune = finished
    values = BASE | {"scenarios": ["toy_rope_lift_smooth"], "methods": ["search_only"]}
    config.merge(values, config.read_yaml(folder / "best.yaml"))
    bench = benchmark.Benchmark(values, Path(__file__).parents[2])
    by_slot = slots(folder, tune)
    best = min(by_slot.values(), key=lambda slot: slot.trials[-1].value).trials[-1]
    tuned = benchmark.with_method(bench.config, bench.methods["baseline_small"], "baseline_small").fit
    assert list(bench.methods) == ["baseline", "baseline_small"]
    assert (tuned.learning_rate, tuned.horizon, tuned.damping) == tuple(best.params[f"fit.{n}"] for n in NAMES)
    assert benchmark.with_method(bench.config, bench.methods["baseline"], "baseline").fit == settings().fit


NAMES = ("learning_rate", "horizon", "damping")


def test_varied_search_settings_and_clusters_get_a_search_row(folder):
    space = {"clusters": {"low": 2, "high": 3}, "search.sigma": {"choices": [0.1, 0.3]}}
    tune = sweep(method="search_only", trials=2, space=space | {"simulation.gravity": {"choices": [9.8, 9.7]}})
    work(folder, tune)
    report(folder, tune)
    assert len(list(folder.glob("search-*/search.json"))) == 2
    best = min(slots(folder, tune).values(), key=lambda slot: slot.trials[-1].value)
    values = best.trials[-1].user_attrs["values"]
    row = config.read_yaml(folder / "searches.yaml")["search_only_small"]
    assert row["clusters"] == values["clusters"]
    assert row["settings"] == {"sigma": values["search.sigma"]}
    assert config.read_yaml(folder / "methods.yaml")["search_only_small"]["search"] == "search_only_small"
    assert config.read_yaml(folder / "best.yaml")["simulation"] == {"gravity": values["simulation.gravity"]}
    # The baseline has one region and sigma 1/6, which the space cannot hold: it is trial 0 all the same.
    first = slots(folder, tune)[0].trials[-1]
    assert first.user_attrs["values"] == {"clusters": 1, "search.sigma": 1 / 6, "simulation.gravity": 9.8}
    assert first.params == {"simulation.gravity": 9.8}
