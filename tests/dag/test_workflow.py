"""The real workflow on tiny configurations: it runs, explains bad input, and resumes after a kill."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

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
    add_scenario,
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
    assert {"time", "memory", "converged"} < set(scores["task"])
    assert np.isfinite(scores["value"]).all()
    scores = scores[scores["task"].isin(TASKS)]
    found = set(scores["metric"])
    assert len(scores[["method", "task", "metric"]].drop_duplicates()) == len(scores) == 2 * len(TASKS) * len(found)
    assert {"chamfer", "track_error", "track_error_bound"} <= found <= {metric.name for metric in metrics_of("positions")}
    assert {path.read_text().strip() for path in results.glob("*/*/*/mlflow.txt")} == {"logged"}
    # Everything is there already: sync finds two complete runs and sends nothing.
    assert {word: len(names) for word, names in tracking.sync(results, config.Tracking()).items()} == {"already logged": 2}


def test_a_finished_run_has_nothing_to_do_and_a_changed_setting_says_what_it_makes_again(tiny_run):
    project, output = tiny_run
    assert jobs_in(output) == {"perceive": 1, "search": 1, "fit": 1, "run": 2, "tables": 1, "page": 1, "all": 1}
    shutil.rmtree(project / ".snakemake")
    assert plan(project) == {}
    output = run(project, {"fit": {"epochs": 4}}, "--dry-run", "--quiet", "rules")
    assert jobs_in(output) == {"fit": 1, "run": 1, "tables": 1, "page": 1, "all": 1}
    assert "fit (1): fit.fit.epochs 3 -> 4\n" in output


@pytest.mark.slow
def test_a_killed_run_continues_in_the_middle_of_the_fit_and_ends_the_same(tiny_run, tmp_path):
    changes = {"methods": ["baseline"], "fit": {"epochs": 30}, "tracking": {"enabled": False}}
    # Both begin with the search that is there.
    undisturbed, project = (copy_project(tiny_run[0], tmp_path / name) for name in ("undisturbed", "killed"))
    assert jobs_in(run(undisturbed, changes, "--until", "fit")) == {"fit": 1}
    command = arguments(project, changes, "--until", "fit")
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    process = subprocess.Popen(command, cwd=project, env=environment(), **silent)
    folder = project / "results" / SCENE / "baseline" / "0"
    deadline = time.monotonic() + 120
    while not (folder / "fit.partial.npz").exists():
        assert process.poll() is None, "the run ended before its first checkpoint"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert json.loads((folder / "fit.json").read_text())["settings"]["fit"]["epochs"] == 3

    run(project, changes, "--until", "fit")
    [log] = (project / "results" / "jobs" / "fit").rglob("*.log")
    assert "resuming the fit after epoch" in log.read_text()
    assert json.loads((folder / "fit.json").read_text())["attempts"] == 2
    expected = Twin.load(undisturbed / "results" / SCENE / "baseline" / "0" / "twin.npz")
    np.testing.assert_array_equal(Twin.load(folder / "twin.npz").material.stiffness, expected.material.stiffness)


@pytest.mark.slow
def test_one_step_alone_from_another_folder_into_a_path_with_spaces_and_quotes(project, tmp_path):
    results = tmp_path / "my 'best' results; echo"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    arguments(project)
    overlays = [str(project / name) for name in ("config/data/demo.yaml", "overlay.yaml")]
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(project / "Snakefile"), "--cores", "1", "--until", "perceive"]
    output_of(start([*command, "--configfile", *overlays, "--config", f"results={results}"], elsewhere))
    assert (results / SCENE / "observations.npz").is_file()
    assert [path.name for path in elsewhere.iterdir()] == [".snakemake"]


@pytest.mark.slow
def test_a_failing_job_is_named_with_its_log_and_stops_no_other(project):
    """The small files of the second recording are right, which a plan reads, and the large one is damaged."""
    add_scenario(project, "gone", "phystwin")
    data = project / "data" / "gone"
    data.mkdir(parents=True)
    (data / "final_data.pkl").write_text("no pickle")
    (data / "split.json").write_text('{"train": [0, 5], "test": [5, 8]}')
    changes = {
        "scenarios": [SCENE, "gone"],
        "methods": ["static"],
        "data_root": str(project / "data"),
        "tracking": {"enabled": False},
    }
    output = run(project, changes, fails=True)
    assert "perceive gone failed: " in output and (project / "results" / SCENE / "static" / "0" / "run.json").exists()
    assert "Fix the cause, then rerun the same command to resume." in output and "Report so far: " in output


def test_bad_configuration_is_explained_before_any_job(project):
    output = run(project, {"fitt": {"epochs": 3}, "scenarios": ["a;touch hacked"]}, "--dry-run", fails=True)
    assert "fitt: unknown key" in output and "scenarios.0: string should match pattern" in output
    assert "Traceback" not in output
    assert not list(project.rglob("hacked"))


def test_the_pinned_conda_environment_has_the_versions_of_the_constraints():
    pins = dict(line.strip().split("==") for line in (ROOT / "workflow/envs/constraints.txt").open() if "==" in line)
    listed = yaml.safe_load((ROOT / "workflow/envs/neuspring.yaml").read_text())["dependencies"][-1]["pip"]
    assert {name: pins[name] for name, _ in (item.split("==") for item in listed)} == dict(item.split("==") for item in listed)
