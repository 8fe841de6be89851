"""Every profile plans the same jobs, wherever they are to run."""

import importlib.util

import pytest

from tests.support.project import jobs_in, run

PLUGINS = {"slurm": "snakemake_executor_plugin_slurm", "kubernetes": "snakemake_executor_plugin_cluster_generic"}
JOBS = {
    **{"track_init": 1, "observe": 1, "search": 1, "fit": 1, "rollout": 2, "score": 2, "log_run": 2},
    **{"tables": 1, "report": 1, "all": 1},
}


@pytest.mark.parametrize("profile", ["server", "slurm", "kubernetes"])
def test_a_profile_plans_every_job_and_jobs_of_a_cluster_ask_for_gpus_that_this_machine_may_lack(project, profile):
    plugin = PLUGINS.get(profile)
    if plugin and importlib.util.find_spec(plugin) is None:
        pytest.skip(f"needs the plugin of this profile: pip install 'neuspring[{profile}]'")
    # As config/README.md and workflow/README.md say of a search.
    told = ("--printshellcmds", "--set-threads", "search=2")
    changes = {"device": "cuda" if plugin else "cpu", "twins_per_launch": 3}
    output = run(project, changes, "--dry-run", *told, profile=profile)
    assert jobs_in(output) == JOBS
    # search, fit and two of rollout.
    assert not plugin or output.count("gpu=1") == 4
    if profile != "server":  # which prints no commands
        [command] = [line for line in output.splitlines() if "-m neuspring search" in line]
        assert " --twins-per-launch 3 " in command and " --threads 2 " in command
