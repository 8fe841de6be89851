"""The workflow on several GPUs, its targets and parts, the whole benchmark, and runs made again."""

import json
import os
import subprocess
import sys
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import pandas as pd
import pytest

from neuspring.core.job_records import read_jobs
from neuspring.data.cases import released_cases
from neuspring.experiments.jobs import gpus
from tests.support.filmed import film, write_raw
from tests.support.project import ROOT, SCENE, arguments, copy_workflow, jobs

TWO_GPUS = {gpus.VISIBLE: "0,1"}
"""Devices that are not there: torch falls back to the CPU with device: auto, leases do not mind."""


def snakemake(project, changes=None, *extra, **environment):
    variables = os.environ | {"PYTHONPATH": str(ROOT), gpus.LOCKS: str(project / "locks")} | environment
    command = arguments(project, changes, *extra)
    return subprocess.run(command, cwd=project, env=variables, capture_output=True, text=True, timeout=400, check=False)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run on two GPUs that are not there."""
    project = copy_workflow(tmp_path_factory.mktemp("scale") / "project")
    changes = {"device": "auto", "seeds": [0, 1], "tracking": {"enabled": False}}
    done = snakemake(project, changes, "--cores", "4", **TWO_GPUS)
    assert done.returncode == 0, done.stdout + done.stderr
    return project, changes, done


def test_jobs_lease_a_gpu_each_and_those_without_need_hold_none(finished):
    project, _, done = finished
    assert "GPU-hours" in done.stdout
    assert "with 2 GPU slots and 4 cores: at least" in done.stdout
    held: dict[str, list[tuple[float, float]]] = {"0": [], "1": []}
    needed = {"search", "fit", "rollout", "render", "appearance"}
    for job in read_jobs(project / "results"):
        for attempt in job.attempts:
            assert len(attempt.devices) == (job.rule in needed), job.name
            start = datetime.fromisoformat(attempt.started).timestamp()
            for device in attempt.devices:
                held[device].append((start, start + attempt.seconds))
    assert all(held.values()), "both devices were used"
    for times in held.values():
        # Starts are kept in milliseconds.
        assert all(later[0] >= earlier[1] - 0.002 for earlier, later in pairwise(sorted(times)))


def test_more_gpus_than_there_are_end_the_run_before_its_first_job(finished):
    project, changes, _ = finished
    done = snakemake(project, changes, "--resources", "gpu=3", "--dry-run", **TWO_GPUS)
    assert done.returncode == 1
    assert "--resources gpu: there are 2 GPU slots (2 GPUs, gpus.jobs_per_gpu 1); received 3" in done.stdout + done.stderr
    done = snakemake(project, changes | {"gpus": {"devices": [0, 7]}}, "--dry-run", **TWO_GPUS)
    assert "received 7; allowed: 0, 1" in done.stdout + done.stderr
    done = snakemake(project, changes, "--dry-run", "--set-resources", "fit:gpu=3", **TWO_GPUS)
    assert "--set-resources fit:gpu: a job has its GPUs at once, and there are 2 (0, 1); received 3" in done.stdout + done.stderr
    done = snakemake(project, changes | {"device": "cuda"}, **{gpus.VISIBLE: ""})
    assert "device: cuda needs a GPU that this run may use, and there is none" in done.stdout + done.stderr


def test_runs_made_again_with_the_same_seed_are_equal_bit_for_bit(finished):
    project, changes, _ = finished
    folder = project / "results" / SCENE / "baseline" / "1"

    def made():
        fit = json.loads((folder / "fit.json").read_text())
        return json.loads((folder / "run.json").read_text())["run_key"], fit["files"]["twin"][1], fit["started"]

    first = made()
    target = f"results/{SCENE}/baseline/1/run.json"
    done = snakemake(project, changes, "--forcerun", "search", "fit", "--", target, **TWO_GPUS)
    assert done.returncode == 0, done.stdout + done.stderr
    again = made()
    assert again[:2] == first[:2]
    assert again[2] != first[2], "it was made again"


def test_a_study_is_a_target_and_explain_names_its_runs(finished):
    project, changes, _ = finished
    done = snakemake(project, changes, "--", "table2", **TWO_GPUS)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (project / "results" / "tables" / "studies" / "table2.md").read_text()
    assert "Model-A (PT)" in page
    assert "not run" in page
    command = [sys.executable, "-m", "neuspring", "explain", "table2/Baseline/future/chamfer", "--results", "results"]
    told = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stdout + told.stderr
    key = json.loads((project / "results" / SCENE / "baseline" / "0" / "run.json").read_text())["run_key"]
    assert key[:12] in told.stdout


def test_a_part_of_the_runs_is_chosen_on_the_command_line(finished):
    project, changes, _ = finished
    planned = jobs(snakemake(project, changes | {"fit": {"epochs": 4}, "only": "method=baseline seed=1"}, "--dry-run", **TWO_GPUS))
    assert planned == {"fit": 1, "rollout": 1, "score": 1, "tables": 1, "report": 1, "all": 1}
    # Made for a part, tables still show all that is there.
    done = snakemake(project, changes | {"only": "method=search_only seed=0"}, **TWO_GPUS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert jobs(done) == {"tables": 1, "report": 1, "all": 1}
    runs = pd.read_csv(project / "results" / "tables" / "runs.csv")
    assert sorted(zip(runs["method"], runs["seed"], strict=True)) == [(m, s) for m in ("baseline", "search_only") for s in (0, 1)]
    assert set(runs["status"]) == {"ok"}


def test_a_study_named_like_another_target_is_refused(finished):
    project, changes, _ = finished
    study = {"title": "t", "reference": None, "baseline": "a", "rows": {"a": "baseline"}}
    (project / "config" / "other.yaml").write_text(json.dumps({"fit": study}))
    done = snakemake(project, changes | {"study_table": "config/other.yaml"}, "--dry-run", **TWO_GPUS)
    assert done.returncode == 1
    assert "study fit: this is the name of another target; rename the study" in done.stdout + done.stderr


def test_a_sweep_without_a_study_is_explained(finished):
    project, changes, _ = finished
    done = snakemake(project, changes, "--dry-run", "--", "sweep", **TWO_GPUS)
    assert done.returncode == 1
    assert "The target sweep needs a study" in done.stdout + done.stderr


def test_a_sweep_ends_with_its_best_and_every_trial_in_mlflow(place):
    space = {"fit.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    tune = {"study": "rate", "method": "baseline", "trials": 3, "workers": 2, "startup_trials": 1, "space": space}
    done = snakemake(place, {"tune": tune}, "--", "sweep")
    assert done.returncode == 0, done.stdout + done.stderr
    folder = place / "results" / "tune" / "rate"
    assert len(list((folder / "trials").glob("*/run.json"))) == 3
    assert "best" in (folder / "summary.md").read_text().lower()
    # Three trials and the study.
    assert "logged: 4" in (folder / "mlflow.txt").read_text()


def test_the_whole_benchmark_is_planned_with_its_jobs_and_hours(place, tmp_path):
    for name in released_cases():
        (tmp_path / "data" / "different_types" / name).mkdir(parents=True)
    command = [sys.executable, "-m", "snakemake", "--profile", "workflow/profiles/default"]
    command += ["--cores", "8", "--dry-run", "--quiet", "rules"]
    command += ["--configfile", "config/data/phystwin.yaml", "--config", f"data_root={tmp_path}"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), gpus.VISIBLE: ""}
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=200, check=True)
    # Of the baselines' models Spring-Gaus needs images, which these folders do not have.
    twins, models = 22 * 18 * 3, 22 * 3 * 3
    runs = twins + models
    expected = {"observe": 22, "track_init": 1, "search": 22 * 8 * 3, "fit": 22 * 13 * 3, "rollout": twins}
    expected |= {"train": 22 * 3, "predict": models, "score": runs, "log_run": runs}
    expected |= {"study": 4, "tables": 1, "report": 1, "all": 1}
    assert jobs(done) == expected
    assert f"Expected: {sum(expected.values()) - 1} jobs, " in done.stdout
    # Planned for GPUs, of which this machine need not have one.
    assert "GPU-hours" in done.stdout and "PhysTwin" in done.stdout


def test_damaged_data_of_one_scenario_stop_nobody_else_s_jobs(place):
    case = write_raw(film(place / "mine" / "film"), place / "data" / "film")
    (case / "metadata.json").write_text("{")
    (case / "color" / "0" / "1.png").unlink()
    (case / "color" / "0" / "1.png").symlink_to(place / "gone.png")
    table = place / "config" / "scenarios.tsv"
    table.write_text(table.read_text() + "film\tphystwin_raw\ttoy\tfilm\tfalse\ttrue\n")
    targets = [f"results/{name}/observations.npz" for name in (SCENE, "film")]
    done = snakemake(place, {"scenarios": [SCENE, "film"], "data_root": str(place / "data")}, "--", *targets)
    assert done.returncode == 1
    assert [Path(place / target).exists() for target in targets] == [True, False]
    (failed,) = [job for job in read_jobs(place / "results") if job.failed]
    assert (failed.rule, failed.scenario) == ("capture", "film")
    assert "metadata.json" in failed.last.message
