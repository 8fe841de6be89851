"""The workflow in a folder of its own, with a configuration small enough for a test, and Snakemake run in it."""

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
    "fit": {"epochs": 3},
    "toy": {"frames": 8},
    "device": "cpu",
}
SCENE = TINY["scenarios"][0]
PATIENCE = 600
"""s for one run of the workflow; the longest takes about 100 on two idle cores."""


def copy_workflow(project):
    """A new project folder with the workflow's own files, so that locks and records of two tests do not meet."""
    project.mkdir()
    for name in ("Snakefile", "workflow", "config"):
        source = ROOT / name
        shutil.copytree(source, project / name) if source.is_dir() else shutil.copy(source, project / name)
    return project


def copy_project(project, copy):
    """A copy of a project to change at will. File times are kept, so that nothing in it has to run again."""
    return Path(shutil.copytree(project, copy))


def add_scenario(project, name, source):
    """A row in the project's table of scenarios; its data are in the folder `name` of data_root."""
    table = project / "config" / "scenarios.tsv"
    table.write_text(table.read_text() + f"{name}\t{source}\ttoy\t{name}\tfalse\ttrue\n")


def config_with(changes):
    """The tiny configuration with some of its values changed."""
    values = json.loads(json.dumps(TINY))
    config.merge(values, changes)
    return values


def arguments(project, changes=None, *extra, profile="default", cores=2):
    """The command line of a run. `cores` None: a cluster's scheduler counts them."""
    overlay = project / "overlay.yaml"
    overlay.write_text(yaml.safe_dump(config_with(changes or {})))
    command = [sys.executable, "-m", "snakemake", "--profile", f"workflow/profiles/{profile}"]
    command += [] if cores is None else ["--cores", str(cores)]
    return [*command, "--configfile", "config/data/demo.yaml", str(overlay), *extra]


def environment(**variables):
    """The environment of a run, in which jobs import the package from here."""
    return os.environ | {"PYTHONPATH": str(ROOT)} | variables


def start(command, project, **variables):
    """Start a run; its output is that of stdout and stderr."""
    told = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=project, env=environment(**variables), **told)


def output_of(process, fails=False):
    """Output of a run until its end. Asserts that it succeeds, or that it fails if `fails`."""
    try:
        output, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert (process.returncode != 0) == fails, output
    return output


def run(
    project,
    changes=None,
    *extra,
    fails=False,
    cores=2,
    profile="default",
    **variables,
):
    """Run the workflow to its end; returns its output. Asserts that it succeeds, or that it fails if `fails`."""
    return output_of(start(arguments(project, changes, *extra, profile=profile, cores=cores), project, **variables), fails)


def plan(project, changes=None, *extra, **options):
    """How many jobs of each rule a dry run plans."""
    return jobs_in(run(project, changes, "--dry-run", *extra, **options))


def jobs_in(output):
    """How many jobs of each rule Snakemake's output names; none where nothing is to be done."""
    if "Nothing to be done" in output:
        return {}
    lines = output.split("Job stats:")[1].split("\n\n")[0].splitlines()[3:]
    return {name: int(count) for name, count in (line.split() for line in lines) if name != "total"}
