"""Every profile plans the same jobs, wherever they are to run."""

import importlib.util
import os
import subprocess

import pytest

from tests.support.project import ROOT, arguments, jobs

PLUGINS = {"slurm": "snakemake_executor_plugin_slurm", "kubernetes": "snakemake_executor_plugin_cluster_generic"}
PLANNED = {
    **{"track_init": 1, "observe": 1, "search": 1, "fit": 1, "rollout": 2, "score": 2, "log_run": 2},
    **{"tables": 1, "report": 1, "all": 1},
}


def plan(place, profile: str, device: str):
    plugin = PLUGINS.get(profile)
    if plugin and importlib.util.find_spec(plugin) is None:
        pytest.skip(f"needs the plugin of this profile: pip install 'neuspring[{profile}]'")
    command = arguments(place, {"device": device}, "--dry-run")
    command[command.index("workflow/profiles/default")] = f"workflow/profiles/{profile}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("profile", ["default", "server", "slurm", "kubernetes"])
def test_a_profile_plans_every_job(place, profile):
    result = plan(place, profile, "cpu")
    assert result.returncode == 0, result.stdout + result.stderr
    assert jobs(result) == PLANNED


@pytest.mark.parametrize("profile", PLUGINS)
def test_jobs_of_a_cluster_ask_for_gpus_that_this_machine_may_lack(place, profile):
    result = plan(place, profile, "cuda")
    text = result.stdout + result.stderr
    assert result.returncode == 0, text
    # search, fit and two of rollout.
    assert text.count("gpu=1") == 4
