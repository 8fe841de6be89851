#!/usr/bin/env python3
"""Run Snakemake jobs as Kubernetes Jobs with kubectl: `pods.py submit SCRIPT`, `pods.py status NAME`, `pods.py NAME...`.

Snakemake's cluster-generic executor calls these commands to submit a job, to query its state, and (names only) to cancel jobs.
job.yaml is the template of all jobs.
"""

import json
import subprocess
import sys
from pathlib import Path

import yaml

TEMPLATE = Path(__file__).with_name("job.yaml")
PROPERTIES = "# properties = "
"""Start of the line in a job's script that contains the job's resources."""


def main(arguments: list[str]) -> int:
    """Submit, query or cancel jobs; returns an exit status."""
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
    """Create a Job that runs `script`; returns its name."""
    lines = [line for line in script.read_text().splitlines() if line.startswith(PROPERTIES)]
    properties = json.loads(lines[0].removeprefix(PROPERTIES))
    name = kubectl("create", "-f", "-", "-o", "name", text=json.dumps(manifest(properties, script)))
    return name.strip().rpartition("/")[2]


def manifest(properties: dict, script: Path) -> dict:
    """The manifest of the Job for these properties."""
    job = yaml.safe_load(TEMPLATE.read_text())
    resources = properties["resources"]
    rule = properties.get("rule") or properties["groupid"]
    job["metadata"]["generateName"] = f"neuspring-{rule.replace('_', '-').lower()}-"
    pod = job["spec"]["template"]["spec"]
    # The time limit belongs to the pod, because a Job's time limit includes waiting for a GPU.
    pod["activeDeadlineSeconds"] = 60 * resources["runtime"]
    # Memory is also a limit: a job that exceeds it fails without affecting others, and is retried with more memory.
    needs = {"cpu": str(properties["threads"]), "memory": f"{resources['mem_mb']}M"}
    limits = {"memory": needs["memory"]} | ({"nvidia.com/gpu": str(resources["gpu"])} if resources.get("gpu") else {})
    pod["containers"][0] |= {"command": ["/bin/sh", str(script)], "resources": {"requests": needs, "limits": limits}}
    return job


def status(name: str) -> str:
    """The state for Snakemake: `running`, `success` or `failed`. If the cluster does not answer, a job counts as running."""
    result = subprocess.run(["kubectl", "get", "job", name, "-o", "json"], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        print(result.stderr, file=sys.stderr, end="")
        return "failed" if "NotFound" in result.stderr else "running"
    conditions = json.loads(result.stdout).get("status", {}).get("conditions") or []
    reached = {condition["type"] for condition in conditions if condition["status"] == "True"}
    return "success" if "Complete" in reached else "failed" if "Failed" in reached else "running"


def kubectl(*arguments: str, text: str | None = None) -> str:
    """Run kubectl and return its output. Raises CalledProcessError; kubectl prints the reason."""
    return subprocess.run(["kubectl", *arguments], input=text, stdout=subprocess.PIPE, text=True, check=True).stdout


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
