"""The workflow's own files in a folder of their own, and a configuration small enough for a test."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import yaml

from neuspring import config

ROOT = Path(__file__).parents[2]
TINY = {
    "scenarios": ["toy_rope_lift_smooth"],
    "methods": ["search_only", "baseline"],
    "seeds": [0],
    "search": {"rollouts": 11},
    "fit": {"epochs": 3, "checkpoint_every": 1},
    "toy": {"frames": 8},
    "device": "cpu",
}
SCENE = TINY["scenarios"][0]


def copy_workflow(project: Path) -> Path:
    """A working copy of the workflow's own files, so that locks and metadata of tests do not meet."""
    project.mkdir()
    for name in ("Snakefile", "workflow", "config"):
        source = ROOT / name
        shutil.copytree(source, project / name) if source.is_dir() else shutil.copy(source, project / name)
    return project


def copy_finished(finished: Path, project: Path) -> Path:
    """A finished project's copy, to change at will; with its times, so that nothing in it is to be done."""
    return Path(shutil.copytree(finished, project))


def arguments(project: Path, changes=None, *extra: str) -> list[str]:
    overlay = project / "overlay.yaml"
    overlay.write_text(yaml.safe_dump(config_with(changes or {})))
    command = [sys.executable, "-m", "snakemake", "--profile", "workflow/profiles/default", "--cores", "2"]
    return [*command, "--configfile", "config/data/demo.yaml", str(overlay), *extra]


def config_with(changes: dict) -> dict:
    values = json.loads(json.dumps(TINY))
    config.merge(values, changes)
    return values


def run(project: Path, changes=None, *extra: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        arguments(project, changes, *extra), cwd=project, env=environment, capture_output=True, text=True, timeout=600, check=False
    )


def jobs(result: subprocess.CompletedProcess[str]) -> dict[str, int]:
    return planned_jobs(result.stdout + result.stderr)


def planned_jobs(output: str) -> dict[str, int]:
    lines = output.split("Job stats:")[1].split("\n\n")[0].splitlines()[3:]
    return {name: int(count) for name, count in (line.split() for line in lines) if name != "total"}
