"""A small run on a real Slurm of one node with two substitutes for GPUs; one job is cancelled."""

import itertools
import json
import subprocess
import sys
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from neuspring.core.job_records import read_jobs
from tests.support import slurm
from tests.support.project import SCENE, config_with, copy_workflow, environment

pytestmark = pytest.mark.slow
"""Small versions: what a profile asks of a cluster in test_profiles and, with a stand-in for the cluster, in test_kubernetes."""
GPU_RULES = {"search", "fit", "run"}
PATIENCE = 600
"""s for the whole run; it took 225 on two cores that five processes shared."""


@pytest.fixture(scope="module")
def slurm_run(tmp_path_factory):
    """The results of a run of two methods, what Slurm knows of its jobs, and the records there were when its fit was cancelled."""
    project = copy_workflow(tmp_path_factory.mktemp("slurm") / "project")
    # On the CPU, but asking for GPUs as on a cluster that has some.
    overlay = config_with({"device": "auto", "fit": {"epochs": 40}})
    (project / "overlay.yaml").write_text(yaml.safe_dump(overlay))
    output = project / "output.txt"
    try:
        with slurm.one_node(), output.open("w") as file:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "snakemake", "--profile", "workflow/profiles/slurm"),
                    *("--default-resources", "slurm_partition=main", "--slurm-init-seconds-before-status-checks", "2"),
                    *("--configfile", "config/data/demo.yaml", "overlay.yaml"),
                ],
                cwd=project,
                env=environment(),
                stdout=file,
                stderr=subprocess.STDOUT,
            )
            try:
                before = cancel_fit_in_the_middle(project, process)
                process.wait(timeout=PATIENCE)
            finally:
                process.kill()
            submissions = slurm.submissions()
    except slurm.NoSlurmError as error:
        pytest.skip(str(error))
    assert process.returncode == 0, output.read_text()
    return project / "results", submissions, before


def cancel_fit_in_the_middle(project: Path, process: subprocess.Popen) -> set[str]:
    deadline = time.monotonic() + PATIENCE
    while not (project / "results" / SCENE / "baseline" / "0" / "fit.partial.npz").exists():
        assert process.poll() is None, (project / "output.txt").read_text()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    [fit] = [job for job in slurm.submissions() if job["Comment"].startswith("rule_fit") and job["JobState"] == "RUNNING"]
    subprocess.run(["scancel", fit["JobId"]], check=True)
    return records(project / "results")


def records(results: Path) -> set[str]:
    return {path.relative_to(results / SCENE).as_posix() for path in (results / SCENE).rglob("*.json") if path.parent.name == "0"}


def submissions_of(submissions: list[dict[str, str]], name: str) -> list[dict[str, str]]:
    return [job for job in submissions if job["Comment"].startswith(f"rule_{name}")]


def test_a_run_on_slurm_ends_with_all_runs_tables_and_records(slurm_run):
    results, submissions, before = slurm_run
    assert "search-uniform/0/search.json" in before
    assert not {"baseline/0/fit.json", "baseline/0/run.json"} & before
    runs = {f"{method}/0/{name}.json" for method in ("search_only", "baseline") for name in ("rollout", "run")}
    assert records(results) == runs | {"search-uniform/0/search.json", "baseline/0/fit.json"}
    scores = pd.read_csv(results / "tables" / "scores.csv")
    assert len(scores) == 8
    assert np.isfinite(scores["value"]).all()
    assert {path.read_text().strip() for path in results.glob("*/*/*/mlflow.txt")} == {"logged"}
    # perceive, search, two of fit, and two runs; the rest runs where Snakemake does.
    assert sorted(job["JobState"] for job in submissions) == ["CANCELLED"] + ["COMPLETED"] * 5


def test_gpu_jobs_ask_for_one_device_and_cpu_jobs_for_none(slurm_run):
    _, submissions, _ = slurm_run
    devices = {job["Comment"].removeprefix("rule_").split("_")[0]: job.get("TresPerJob") for job in submissions}
    gpu = "gres:gpu:1"
    assert devices == {"perceive": None, "search": gpu, "fit": gpu, "run": gpu}
    assert {job["Partition"] for job in submissions} == {"main"}


def test_jobs_use_the_device_that_slurm_gave_them_and_share_none(slurm_run):
    results, _, _ = slurm_run
    leases: dict[str, list[tuple[datetime, datetime]]] = {}
    for job in read_jobs(results):
        assert len(job.devices) == (job.rule in GPU_RULES), job.name
        start = datetime.fromisoformat(job.started)
        for device in job.devices:
            leases.setdefault(device, []).append((start, start + timedelta(seconds=job.seconds)))
    assert set(leases) == {"0", "1"}
    for spans in leases.values():
        spans.sort()
        assert all(end <= start + timedelta(seconds=1) for (_, end), (start, _) in itertools.pairwise(spans))


def test_a_cancelled_job_is_submitted_again_with_more_memory_and_goes_on_from_its_checkpoint(slurm_run):
    results, submissions, _ = slurm_run
    first, second = submissions_of(submissions, "fit")
    assert (first["JobState"], second["JobState"]) == ("CANCELLED", "COMPLETED")
    assert [int(job["MinMemoryNode"].removesuffix("M")) for job in (first, second)] == [8000, 16000]
    name = f"{SCENE}/baseline/0"
    assert json.loads((results / name / "fit.json").read_text())["attempts"] == 2
    assert "resuming the fit after epoch" in next((results / "jobs" / "fit" / name).glob("*.log")).read_text()
