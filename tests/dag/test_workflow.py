"""The real workflow on tiny configurations: it runs, it explains bad input, it survives being killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.experiments.tracking import log as tracking
from neuspring.scores.metrics import TASKS, metrics_of
from tests.support.project import (
    ROOT,
    SCENE,
    arguments,
    copy_project,
    copy_workflow,
    environment,
    jobs_in,
    output_of,
    plan,
    run,
    start,
)


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """The project folder of a run of two methods, and what the run said."""
    project = copy_workflow(tmp_path_factory.mktemp("dag") / "project")
    return project, run(project)


def test_a_configuration_becomes_a_table_with_every_run_in_mlflow(tiny_run):
    project, output = tiny_run
    results = project / "results"
    assert "(`baseline`)" in output
    assert "neuspring ui --results results" in output
    scores = pd.read_csv(results / "tables" / "scores.csv")
    found = set(scores["metric"])
    assert len(scores[["method", "task", "metric"]].drop_duplicates()) == len(scores) == 2 * len(TASKS) * len(found)
    assert {"chamfer", "track_error", "track_error_bound"} <= found <= {metric.name for metric in metrics_of("positions")}
    assert np.isfinite(scores["value"]).all()
    assert {path.read_text().strip() for path in results.glob("*/*/*/mlflow.txt")} == {"logged"}
    # Everything is there already: sync finds two complete runs and sends nothing.
    assert {word: len(names) for word, names in tracking.sync(results, config.Tracking()).items()} == {"already logged": 2}


def test_the_search_is_shared_and_changed_settings_rerun_the_stages_that_use_them_and_no_others(tiny_run):
    project, output = tiny_run
    assert jobs_in(output)["search"] == 1
    # How candidates are simulated changes no result; the report states it, as the whole configuration.
    assert plan(project, {"twins_per_launch": 3}, "--set-threads", "search=2") == {"report": 1, "all": 1}
    # Both runs go to another experiment of MLflow; what is fitted is made again, and all of another seed is made.
    expected = dict.fromkeys(["track_init", "search", "tables", "report", "all"], 1)
    expected |= {"fit": 2, "rollout": 3, "score": 3, "log_run": 4}
    assert plan(project, {"fit": {"epochs": 4}, "tracking": {"experiment": "other"}, "seeds": [0, 1]}) == expected


def test_what_results_were_made_with_is_read_from_their_records_and_from_nothing_that_stays_behind(tiny_run, tmp_path):
    """A results folder that was renamed, and whose `.snakemake` is gone: Snakemake would take it as finished whatever is asked."""
    project = copy_project(tiny_run[0], tmp_path / "project")
    shutil.rmtree(project / ".snakemake")
    (project / "results").rename(project / "kept")
    assert plan(project, {"results": "kept"}) == {}
    changes = {"results": "kept", "fit": {"epochs": 4}, "compare_with": "search_only"}
    output = run(project, changes, "--dry-run", "--quiet", "rules")
    assert jobs_in(output) == dict.fromkeys(["fit", "rollout", "score", "log_run", "tables", "report", "all"], 1)
    assert "  fit (baseline, 1 job): fit.epochs 3 -> 4\n" in output
    assert "  tables (1 job): what it was told, or its code\n" in output
    assert "To keep what is there, give another folder: --config results=" in output
    assert plan(project, {"results": "kept", "toy": {"frames": 9}}, "--rerun-triggers", "mtime") == {}


@pytest.mark.slow
def test_a_killed_run_continues_in_the_middle_of_the_fit_and_ends_the_same(tiny_run, tmp_path):
    changes = {"methods": ["baseline"], "fit": {"epochs": 30}, "tracking": {"enabled": False}}
    target = f"results/{SCENE}/baseline/0/fit.json"
    # Both begin with the search that is there.
    undisturbed, project = (copy_project(tiny_run[0], tmp_path / name) for name in ("undisturbed", "killed"))
    assert jobs_in(run(undisturbed, changes, "--", target)) == {"fit": 1}

    process = subprocess.Popen(
        arguments(project, changes, "--", target),
        cwd=project,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    folder = project / "results" / SCENE / "baseline" / "0"
    deadline = time.monotonic() + 120
    while not (folder / "fit.partial.npz").exists():
        assert process.poll() is None, "the run ended before its first checkpoint"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "fit.json").exists()

    run(project, changes, "--unlock")
    assert "continuing the fit after epoch" in run(project, changes, "--", target)
    assert json.loads((folder / "fit.json").read_text())["attempts"] == 2
    expected = Twin.load(undisturbed / "results" / SCENE / "baseline" / "0" / "twin.npz")
    np.testing.assert_array_equal(Twin.load(folder / "twin.npz").material.stiffness, expected.material.stiffness)


def test_one_step_alone_from_another_folder_into_a_path_with_spaces_and_quotes(project, tmp_path):
    results = tmp_path / "my 'best' results; echo"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    arguments(project)
    overlays = [str(project / name) for name in ("config/data/demo.yaml", "overlay.yaml")]
    target = f"{results}/{SCENE}/observations.npz"
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(project / "Snakefile"), "--cores", "1"]
    command += ["--configfile", *overlays, "--config", f"results={results}", "--", target]
    output_of(start(command, elsewhere))
    assert Path(target).is_file()
    assert [path.name for path in elsewhere.iterdir()] == [".snakemake"]


def test_bad_configuration_is_explained_before_any_job(project):
    output = run(project, {"fitt": {"epochs": 3}, "scenarios": ["a;touch hacked"]}, "--dry-run", fails=True)
    assert "fitt: unknown key" in output and "scenarios.0: string should match pattern" in output
    assert "Traceback" not in output
    assert not list(project.rglob("hacked"))


def test_the_pinned_conda_environment_has_the_versions_of_the_constraints():
    pins = dict(line.strip().split("==") for line in (ROOT / "workflow/envs/constraints.txt").open() if "==" in line)
    listed = yaml.safe_load((ROOT / "workflow/envs/neuspring.yaml").read_text())["dependencies"][-1]["pip"]
    assert {name: pins[name] for name, _ in (item.split("==") for item in listed)} == dict(item.split("==") for item in listed)
