"""The real workflow with many methods, larger budgets and runs that fail."""

import json
import re
from pathlib import Path

import pandas as pd
import pytest

from neuspring import config
from neuspring.experiments.tracking import log as tracking
from tests.support.extensions import with_extensions
from tests.support.project import SCENE, plan, run


@pytest.mark.slow
def test_variants_end_in_one_table_and_a_larger_budget_continues_the_search(project):
    changes = {
        "methods": ["neuspring", "pt_only"],
        "seeds": [0, 1],
        "fit": {"epochs": 1},
        "transfers": {SCENE: ["toy_rope_shake_smooth"], "toy_rope_shake_smooth": [SCENE]},
        "tracking": {"enabled": False},
        "only": "seed=0",
    }
    run(project, changes)
    results = project / "results"
    summary = (results / "tables" / "summary.md").read_text()
    assert all(re.search(rf"^\| [^|]*\(`{name}`\) +\|", summary, re.M) for name in changes["methods"])
    assert "Transfer TE" in summary
    transfers = pd.read_csv(results / "tables" / "scores.csv").query("task == 'transfer'")
    # The other recording is no source, since it is not a scenario.
    assert set(transfers["method"]) == set(changes["methods"])
    assert set(transfers["scenario"]) == {SCENE}
    record = json.loads((results / SCENE / "neuspring" / "0" / "run.json").read_text())
    assert record["variant"]["clusters"] == 5
    assert record["variant"]["field.plane_learning_rate"] == 0.03
    # test_workflow runs the job that logs. Here the records are logged from this process, which saves a start for each.
    tracking.init(results, config.Tracking())
    assert {word: len(names) for word, names in tracking.sync(results, config.Tracking()).items()} == {"logged": 2}
    assert {Path(name).name for name in record["artifacts"]["plots"]} >= {"topology.png", "stiffness.png", "motion.png"}

    changes |= {"search": {"rollouts": 15}, "methods": ["pt_only"], "seeds": [0], "transfers": {}, "only": ""}
    run(project, changes, "--until", "run")
    logs = (project / "results" / "jobs" / "search").rglob("*.log")
    assert any("resuming the search after 11 rollouts" in log.read_text() for log in logs)
    assert len(pd.read_parquet(results / SCENE / "search-piecewise_5" / "0" / "trace.parquet")) == 15


@pytest.mark.slow
@with_extensions
def test_baselines_pass_through_the_same_workflow_and_say_where_they_do_not_apply(project):
    changes = {
        "methods": ["search_only", "static", "controller_lbs", "spring_gaus", "spring_gaus_points", "gs_dynamics"],
        "baselines": {
            "spring_gaus": {"anchors": 60, "iterations": 1},
            "gs_dynamics": {"width": 8, "batch": 2, "epochs": 1, "updates_per_epoch": 2, "step": 0.002},
        },
        "studies": ["table1"],
        "study_table": "config/systems.yaml",
        "transfers": {SCENE: ["toy_rope_shake_smooth"]},
        "compare_with": "static",
        "tracking": {"enabled": False},
    }
    # Table 1 without PhysTwin and NeuSpring, whose runs it would add; with fewer rows it is no longer the paper's.
    table1 = config.read_yaml(project / "config" / "studies.yaml")["table1"]
    rows = {label: method for label, method in table1["rows"].items() if method in changes["methods"]}
    (project / "config" / "systems.yaml").write_text(
        json.dumps({"table1": table1 | {"reference": None, "baseline": "GS-Dynamics", "rows": rows}})
    )
    run(project, changes)
    results = project / "results"
    summary = (results / "tables" / "summary.md").read_text()
    assert re.search(rf"spring_gaus.* does not apply .*{SCENE}.* it needs images", summary)
    runs = pd.read_csv(results / "tables" / "runs.csv")
    assert set(runs["method"]) == set(changes["methods"]) - {"spring_gaus"}
    assert set(runs["status"]) == {"ok"}
    # Of the baselines only GS-Dynamics was ever moved to other recordings; what learns nothing is the floor.
    moved = pd.read_csv(results / "tables" / "scores.csv").query("task == 'transfer'")
    assert set(moved["method"]) == {"search_only", "gs_dynamics", "static", "controller_lbs"}
    folder = results / SCENE / "gs_dynamics" / "0"
    assert {"train.json", "model.npz", "history.parquet", "rollout.json", "trajectory.npz", "run.json"} <= set(names(folder))
    assert "train.json" not in names(results / SCENE / "static" / "0")
    assert "GS-Dynamics" in (results / "tables" / "studies" / "table1.md").read_text()
    assert "spring_gaus_points" in (results / "tables" / "report.html").read_text()
    # A model's own settings train it alone again.
    changes["baselines"]["gs_dynamics"]["epochs"] = 2
    jobs = plan(project, changes)
    assert (jobs["train"], jobs["run"]) == (1, 1)
    assert "search" not in jobs


def names(folder):
    return [path.name for path in folder.iterdir()]
