#!/usr/bin/env python3
"""Jobs of Snakemake as Jobs of Kubernetes, through kubectl: `pods.py submit SCRIPT`, `pods.py status NAME`, `pods.py NAME...`.

Snakemake's cluster-generic executor calls these to submit a job, to ask for its state, and (names alone) to cancel jobs. The
part that all jobs share is in job.yaml.
"""

import json
import subprocess
import sys
from pathlib import Path

import yaml

TEMPLATE = Path(__file__).with_name("job.yaml")
PROPERTIES = "# properties = "
"""Begins the line of a job's script that says what the job needs."""


def main(arguments: list[str]) -> int:
    """Submit, ask or cancel; returns an exit status."""
    match arguments:
        case ["submit", script]:
            print(submit(Path(script)))
        case ["status", name]:
            print(status(name))
        case [_, *_]:
            kubectl("delete", "job", "--wait=false", "--ignore-not-found", *arguments)
        case _:
            print(__doc__, file=sys.stderr)
            return 2
    return 0


def submit(script: Path) -> str:
    """Make a Job that runs `script`; returns its name."""
    lines = [line for line in script.read_text().splitlines() if line.startswith(PROPERTIES)]
    properties = json.loads(lines[0].removeprefix(PROPERTIES))
    name = kubectl("create", "-f", "-", "-o", "name", text=json.dumps(manifest(properties, script)))
    return name.strip().rpartition("/")[2]


def manifest(properties: dict, script: Path) -> dict:
    """The Job of a job with these properties."""
    job = yaml.safe_load(TEMPLATE.read_text())
    resources = properties["resources"]
    rule = properties.get("rule") or properties["groupid"]
    job["metadata"]["generateName"] = f"neuspring-{rule.replace('_', '-').lower()}-"
    pod = job["spec"]["template"]["spec"]
    # Set for the pod: a Job's time limit would also count while it waits for a GPU.
    pod["activeDeadlineSeconds"] = 60 * resources["runtime"]
    # Memory is a limit too: a job that needs more fails alone, and is tried again with more.
    needs = {"cpu": str(properties["threads"]), "memory": f"{resources['mem_mb']}M"}
    limits = {"memory": needs["memory"]} | ({"nvidia.com/gpu": str(resources["gpu"])} if resources.get("gpu") else {})
    pod["containers"][0] |= {"command": ["/bin/sh", str(script)], "resources": {"requests": needs, "limits": limits}}
    return job


def status(name: str) -> str:
    """`running`, `success` or `failed`, as Snakemake takes it. While the cluster does not answer, a job counts as running."""
    result = subprocess.run(["kubectl", "get", "job", name, "-o", "json"], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        print(result.stderr, file=sys.stderr, end="")
        return "failed" if "NotFound" in result.stderr else "running"
    conditions = json.loads(result.stdout).get("status", {}).get("conditions") or []
    reached = {condition["type"] for condition in conditions if condition["status"] == "True"}
    return "success" if "Complete" in reached else "failed" if "Failed" in reached else "running"


def kubectl(*arguments: str, text: str | None = None) -> str:
    """Its output. Raises CalledProcessError, after kubectl has said why."""
    return subprocess.run(["kubectl", *arguments], input=text, stdout=subprocess.PIPE, text=True, check=True).stdout


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
