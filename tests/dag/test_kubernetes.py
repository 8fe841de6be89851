"""The profile for Kubernetes with a stand-in for kubectl, whose pods are processes of this machine; no cluster."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest

from neuspring.core.job_records import read_jobs
from tests.support.project import ROOT, SCENE, arguments

PODS = ROOT / "workflow/profiles/kubernetes/pods.py"
GPU = "nvidia.com/gpu"


def kubectl(folder, text: str) -> dict[str, str]:
    """An environment in which kubectl is this shell script."""
    folder.mkdir()
    program = folder / "kubectl"
    program.write_text(f"#!/bin/sh\n{text}\n")
    program.chmod(0o755)
    return os.environ | {"PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}


def on_kubernetes(place):
    """The command of a search in pods; a cluster's jobs are not counted by cores."""
    target = f"results/{SCENE}/search-uniform/0/search.json"
    command = arguments(place, {"device": "auto"}, "--seconds-between-status-checks", "1", "--", target)
    command[command.index("workflow/profiles/default")] = "workflow/profiles/kubernetes"
    cores = command.index("--cores")
    del command[cores : cores + 2]
    return command


def test_cores_are_refused_before_any_pod(place, tmp_path):
    if importlib.util.find_spec("snakemake_executor_plugin_cluster_generic") is None:
        pytest.skip("needs snakemake-executor-plugin-cluster-generic: pip install 'neuspring[kubernetes]'")
    command = on_kubernetes(place)
    environment = kubectl(tmp_path / "bin", f'touch "{tmp_path / "asked"}"')
    options = {"cwd": place, "env": environment, "capture_output": True, "text": True, "timeout": 300, "check": False}
    done = subprocess.run([*command[:3], "--cores", "2", *command[3:]], **options)
    assert done.returncode == 1
    assert "--cores: a cluster's scheduler counts cores itself" in done.stderr
    assert not (tmp_path / "asked").exists()


def test_jobs_run_as_pods_with_what_they_need_and_an_evicted_one_is_tried_again_with_more_memory(place, tmp_path):
    if importlib.util.find_spec("snakemake_executor_plugin_cluster_generic") is None:
        pytest.skip("needs snakemake-executor-plugin-cluster-generic: pip install 'neuspring[kubernetes]'")
    pods = tmp_path / "pods"
    pods.mkdir()
    (pods / "evicted").write_text("1")
    command = on_kubernetes(place)
    environment = kubectl(tmp_path / "bin", f'exec "{sys.executable}" "{ROOT}/tests/support/kubectl.py" "$@"')
    # pods.py takes the environment's python3.
    (tmp_path / "bin" / "python3").symlink_to(sys.executable)
    environment["KUBECTL_FOLDER"] = str(pods)
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr + "".join(path.read_text() for path in pods.glob("*.log"))

    manifests = [json.loads(path.read_text()) for path in sorted(pods.glob("*.json"))]
    assert [job["metadata"]["generateName"] for job in manifests] == ["neuspring-observe-", *["neuspring-search-"] * 2]
    containers = [job["spec"]["template"]["spec"]["containers"][0] for job in manifests]
    needs = [{"cpu": "1", "memory": memory} for memory in ("4000M", "8000M", "16000M")]
    assert [container["resources"]["requests"] for container in containers] == needs
    limits = [{"memory": "4000M"}, {"memory": "8000M", GPU: "1"}, {"memory": "16000M", GPU: "1"}]
    assert [container["resources"]["limits"] for container in containers] == limits
    pods = [job["spec"]["template"]["spec"] for job in manifests]
    assert [pod["activeDeadlineSeconds"] for pod in pods] == [60 * minutes for minutes in (30, 240, 480)]
    assert {job["spec"]["backoffLimit"] for job in manifests} == {0}
    # The evicted pod never began, so only the other one left a trace.
    ran = {job.name: [attempt.outcome for attempt in job.attempts] for job in read_jobs(place / "results")}
    assert ran == {f"observe/{SCENE}": ["ok"], f"search/{SCENE}/uniform/0": ["ok"]}


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ("""echo '{"status": {}}'""", "running"),
        ("""echo '{"status": {"conditions": [{"type": "Complete", "status": "True"}]}}'""", "success"),
        ("""echo '{"status": {"conditions": [{"type": "Failed", "status": "True"}]}}'""", "failed"),
        ("""echo '{"status": {"conditions": [{"type": "Suspended", "status": "False"}]}}'""", "running"),
        ("""echo 'Error from server (NotFound): jobs.batch "a" not found' >&2; exit 1""", "failed"),
        ("""echo 'Unable to connect to the server: dial tcp: i/o timeout' >&2; exit 1""", "running"),
    ],
)
def test_what_kubernetes_says_of_a_job(tmp_path, answer, expected):
    command = [sys.executable, str(PODS), "status", "a"]
    done = subprocess.run(command, env=kubectl(tmp_path / "bin", answer), capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected


def test_names_alone_are_jobs_to_cancel(tmp_path):
    asked = tmp_path / "asked"
    environment = kubectl(tmp_path / "bin", f'echo "$@" > "{asked}"')
    subprocess.run([sys.executable, str(PODS), "a", "b"], env=environment, check=True)
    assert asked.read_text() == "delete job --wait=false --ignore-not-found a b\n"
