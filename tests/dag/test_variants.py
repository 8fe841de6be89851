"""The real workflow with many methods, larger budgets, runs that fail and jobs that break."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from .project import SCENE, jobs, run


def test_variants_end_in_one_table_and_a_larger_budget_continues_the_search(place):
    changes = {
        "methods": ["neuspring", "plus_carry_over", "plus_average"],
        "seeds": [0, 1],
        "fit": {"epochs": 1},
        "transfers": {SCENE: ["toy_rope_shake_smooth"], "toy_rope_shake_smooth": [SCENE]},
    }
    result = run(place, changes)
    text = result.stdout + result.stderr
    assert result.returncode == 0, text
    results = place / "results"
    summary = (results / "tables" / "summary.md").read_text()
    assert all(f"| {name} " in summary for name in changes["methods"])
    assert "## Transfer" in summary
    transfers = pd.read_csv(results / "tables" / "transfers.csv")
    # Averaging and carrying over concern a recording's own future; the other recording is no source, since it is not chosen.
    assert set(transfers["method"]) == {"neuspring"}
    assert set(transfers["scenario"]) == {SCENE}
    averaged = [pd.read_parquet(results / SCENE / "plus_average" / seed / "scores.parquet")["value"] for seed in "01"]
    np.testing.assert_array_equal(*averaged)
    record = json.loads((results / SCENE / "neuspring" / "0" / "run.json").read_text())
    assert record["variant"]["clusters"] == 5
    assert record["variant"]["field.plane_learning_rate"] == 0.01
    assert {path.read_text().strip() for path in results.glob("*/*/*/mlflow.txt")} == {"logged"}
    assert {Path(name).name for name in record["artifacts"]["plots"]} >= {"topology.png", "stiffness.png", "motion.png"}

    more = run(place, changes | {"search": {"rollouts": 15}, "methods": ["pt_only"], "seeds": [0], "transfers": {}})
    text = more.stdout + more.stderr
    assert more.returncode == 0, text
    assert "continuing the search after 11 rollouts" in text
    assert len(pd.read_parquet(results / SCENE / "search-piecewise_5" / "0" / "trace.parquet")) == 15


def test_a_numerical_failure_stops_nothing_and_shows_in_the_table(place):
    # No candidate can be integrated with a single substep, so the search fails numerically.
    changes = {"simulation": {"max_substeps": 1}, "methods": ["search_only"], "tracking": {"enabled": False}}
    result = run(place, changes)
    text = result.stdout + result.stderr
    assert result.returncode == 0, text
    assert "0/1 (1 failed)" in text
    assert "none of 11 candidates could be simulated" in text


def test_a_job_that_breaks_does_not_stop_the_others(place):
    changes = {"scenarios": [SCENE, "DLO1_train_48"], "methods": ["search_only"], "tracking": {"enabled": False}}
    changes |= {"data_root": str(place / "data")}
    broken = place / "data" / "DLO1" / "train" / "48.pkl"
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"\x80\x04 truncated")
    result = run(place, changes)
    text = result.stdout + result.stderr
    assert result.returncode == 1
    assert f"neuspring: error: {broken}" in text
    assert "MissingOutputException" not in text, "the command fails by its status"
    assert "not tried again (bad input)" in text
    # The healthy scenario is finished and in the table; the broken one is listed as missing.
    assert (place / "results" / SCENE / "search_only" / "0" / "run.json").exists()
    assert "DLO1_train_48 / search_only / seed 0: missing" in text
    assert "1/2" in text
    # What the interrupted run printed does not pass for the table: the next one goes on.
    planned = jobs(run(place, changes, "--dry-run"))
    assert planned == {"observe": 1, "search": 1, "rollout": 1, "score": 1, "tables": 1, "report": 1, "all": 1}
