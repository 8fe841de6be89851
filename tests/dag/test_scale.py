"""The workflow on several GPUs, its targets and parts, the whole benchmark, and runs made again."""

import json
import sys
from datetime import datetime
from itertools import pairwise

import pandas as pd
import pytest

from neuspring import config
from neuspring.core.job_records import read_jobs
from neuspring.experiments import gpus
from tests.support.project import SCENE, copy_workflow, jobs_in, output_of, run, start

CHANGES = {"device": "auto", "seeds": [0, 1], "tracking": {"enabled": False}}


def run_on_two_gpus(project, changes=None, *extra, fails=False, cores=2, visible="0,1"):
    """Run with two GPUs that are not there: with `device: auto` torch takes the CPU, and leases do not look."""
    variables = {gpus.VISIBLE: visible, gpus.LOCKS: str(project / "locks")}
    return run(project, CHANGES | (changes or {}), *extra, fails=fails, cores=cores, **variables)


@pytest.fixture(scope="module")
def two_gpu_run(tmp_path_factory):
    """The project folder of a run of two methods and two seeds, and what the run said."""
    project = copy_workflow(tmp_path_factory.mktemp("scale") / "project")
    return project, run_on_two_gpus(project, cores=4)


@pytest.mark.slow
def test_jobs_lease_a_gpu_each_and_those_without_need_hold_none(two_gpu_run):
    project, _ = two_gpu_run
    leases = {"0": [], "1": []}
    for job in read_jobs(project / "results"):
        assert len(job.devices) == (job.rule in ("search", "fit", "run")), job.name
        start = datetime.fromisoformat(job.started).timestamp()
        for device in job.devices:
            leases[device].append((start, start + job.seconds))
    assert all(leases.values()), "both devices were used"
    for times in leases.values():
        # Starts are kept in seconds.
        assert all(later[0] >= earlier[1] - 1 for earlier, later in pairwise(sorted(times)))


@pytest.mark.slow
def test_more_gpus_than_there_are_end_the_run_before_its_first_job(project):
    output = run_on_two_gpus(project, {}, "--resources", "gpu=3", "--dry-run", fails=True)
    assert "must be 1 to 2 (2 GPUs, gpus.jobs_per_gpu 1); received 3" in output


@pytest.mark.slow
def test_a_study_is_a_target_and_explain_names_its_runs(two_gpu_run):
    project, _ = two_gpu_run
    # Two of the rows, since each is fitted twice; with fewer rows it is no longer the paper's.
    table2 = config.read_yaml(project / "config" / "studies.yaml")["table2"]
    rows = {label: table2["rows"][label] for label in ("Baseline", "Model-A (PT)")}
    (project / "config" / "two_rows.yaml").write_text(json.dumps({"table2": table2 | {"reference": None, "rows": rows}}))
    run_on_two_gpus(project, {"study_table": "config/two_rows.yaml"}, "--", "table2")
    page = (project / "results" / "tables" / "studies" / "table2.md").read_text()
    assert "Model-A (PT)" in page
    assert "not run" not in page, "the rows that the configuration does not name are made too"
    command = [sys.executable, "-m", "neuspring", "explain", "baseline/future/chamfer", "--results", "results"]
    assert f"results/{SCENE}/baseline/0/run.json" in output_of(start(command, project))


@pytest.mark.slow
def test_a_study_named_like_another_target_is_refused(project):
    study = {"title": "t", "reference": None, "baseline": "a", "rows": {"a": "baseline"}}
    (project / "config" / "other.yaml").write_text(json.dumps({"fit": study}))
    output = run(project, {"study_table": "config/other.yaml"}, "--dry-run", fails=True)
    assert "study fit: another target has this name; rename the study" in output


@pytest.mark.slow
def test_a_sweep_ends_with_its_best(project):
    space = {"fit.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    tune = {"study": "rate", "method": "baseline", "trials": 3, "workers": 2, "space": space}
    run(project, {"tune": tune}, "--", "sweep")
    folder = project / "results" / "tune" / "rate"
    # Two workers that look at the count at the same moment may make one more (Optuna counts trials that are finished).
    assert len((folder / "trials.csv").read_text().splitlines()) - 1 in (3, 4)
    assert "best" in (folder / "summary.md").read_text().lower()


@pytest.mark.slow
def test_a_part_of_the_runs_is_chosen_on_the_command_line(two_gpu_run):
    project, _ = two_gpu_run
    part = {"fit": {"epochs": 4}, "only": "method=baseline seed=1"}
    expected = {"fit": 1, "run": 1, "tables": 1, "page": 1, "all": 1}
    assert jobs_in(run_on_two_gpus(project, part, "--dry-run")) == expected
    # Made for a part, tables still show all that is there.
    output = run_on_two_gpus(project, {"only": "method=search_only seed=0"})
    assert jobs_in(output) == {"tables": 1, "page": 1, "all": 1}
    runs = pd.read_csv(project / "results" / "tables" / "runs.csv")
    assert sorted(zip(runs["method"], runs["seed"], strict=True)) == [(m, s) for m in ("baseline", "search_only") for s in (0, 1)]
    assert set(runs["status"]) == {"ok"}
