"""The profile for Kubernetes with a substitute for kubectl, whose pods are processes of this machine, without a cluster."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib

import pytest
import yaml

from neuspring.core.job_records import read_jobs
from tests.support.project import ROOT, SCENE, arguments, environment, output_of, start

PODS = ROOT / "workflow/profiles/kubernetes/pods.py"
GPU = "nvidia.com/gpu"


def kubectl(folder, text):
    """Variables of an environment in which kubectl is this shell script."""
    folder.mkdir()
    program = folder / "kubectl"
    program.write_text(f"#!/bin/sh\n{text}\n")
    program.chmod(0o755)
    return {"PATH": f"{folder}:{os.environ['PATH']}"}


def search_in_pods(project, cores=None):
    """The command of a search in pods."""
    if importlib.util.find_spec("snakemake_executor_plugin_cluster_generic") is None:
        pytest.skip("needs snakemake-executor-plugin-cluster-generic: pip install 'neuspring[kubernetes]'")
    extra = ("--seconds-between-status-checks", "1", "--until", "search")
    return arguments(project, {"device": "auto"}, *extra, profile="kubernetes", cores=cores)


@pytest.mark.slow
def test_cores_are_refused_before_any_pod(project, tmp_path):
    variables = kubectl(tmp_path / "bin", f'touch "{tmp_path / "called"}"')
    output = output_of(start(search_in_pods(project, cores=2), project, **variables), fails=True)
    assert "--cores: must not be set on a cluster" in output
    assert not (tmp_path / "called").exists()


@pytest.mark.slow
def test_jobs_run_as_pods_with_what_they_need_and_an_evicted_one_is_tried_again_with_more_memory(project, tmp_path):
    pods = tmp_path / "pods"
    pods.mkdir()
    (pods / "evicted").write_text("1")
    variables = kubectl(tmp_path / "bin", f'exec "{sys.executable}" "{ROOT}/tests/support/kubectl.py" "$@"')
    # pods.py runs with the environment's python3.
    (tmp_path / "bin" / "python3").symlink_to(sys.executable)
    output_of(start(search_in_pods(project), project, KUBECTL_FOLDER=str(pods), **variables))

    manifests = [json.loads(path.read_text()) for path in sorted(pods.glob("*.json"))]
    assert [job["metadata"]["generateName"] for job in manifests] == ["neuspring-perceive-", *["neuspring-search-"] * 2]
    containers = [job["spec"]["template"]["spec"]["containers"][0] for job in manifests]
    needs = [{"cpu": "1", "memory": memory} for memory in ("4000M", "8000M", "16000M")]
    assert [container["resources"]["requests"] for container in containers] == needs
    limits = [{"memory": "4000M"}, {"memory": "8000M", GPU: "1"}, {"memory": "16000M", GPU: "1"}]
    assert [container["resources"]["limits"] for container in containers] == limits
    specifications = [job["spec"]["template"]["spec"] for job in manifests]
    assert [pod["activeDeadlineSeconds"] for pod in specifications] == [60 * minutes for minutes in (30, 240, 480)]
    assert {job["spec"]["backoffLimit"] for job in manifests} == {0}
    # The evicted pod never began, so only the other one left a trace.
    assert [job.name for job in read_jobs(project / "results")] == [f"perceive/{SCENE}", f"search/{SCENE}/uniform/0"]


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
    variables = environment(**kubectl(tmp_path / "bin", answer))
    result = subprocess.run([sys.executable, str(PODS), "status", "a"], env=variables, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == expected


def test_names_alone_are_jobs_to_cancel(tmp_path):
    calls = tmp_path / "calls"
    variables = environment(**kubectl(tmp_path / "bin", f'echo "$@" > "{calls}"'))
    subprocess.run([sys.executable, str(PODS), "a", "b"], env=variables, check=True)
    assert calls.read_text() == "delete job --wait=false --ignore-not-found a b\n"


def image_copies():
    """Files that the image's recipe copies to /source."""
    lines = re.findall(r"^COPY (.+) /source\S*$", (ROOT / "workflow" / "envs" / "Dockerfile").read_text(), re.MULTILINE)
    return [name for line in lines for name in line.split()]


def test_the_image_is_built_of_files_and_extras_that_there_are():
    """No test builds it: a job of CI does, from these names."""
    copied = image_copies()
    text = (ROOT / ".github" / "workflows" / "image.yml").read_text()
    job = yaml.safe_load(text)
    # YAML reads the key `on` as true.
    named = [*job[True]["push"]["paths"], *re.findall(r"(?:--file|--profile|--configfile) (\S+)", text)]
    assert [name for name in (*copied, *named) if not (ROOT / name.removesuffix("/**")).exists()] == []
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (chosen,) = re.findall(r"EXTRAS=(\S+)", text)
    # Those that `make demo` installs, among others.
    wanted = re.findall(r"INSTALL,(\w+)\$\(COMMA\)(\w+)", (ROOT / "Makefile").read_text())[0]
    assert set(wanted) <= set(chosen.split(",")) <= extras.keys()
