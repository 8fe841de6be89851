"""Every profile plans the same jobs."""

import importlib.util

import pytest

from tests.support.project import jobs_in, run

PLUGINS = {"slurm": "snakemake_executor_plugin_slurm", "kubernetes": "snakemake_executor_plugin_cluster_generic"}
JOBS = {"perceive": 1, "search": 1, "fit": 1, "run": 2, "tables": 1, "page": 1, "all": 1}


@pytest.mark.parametrize("profile", ["slurm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("server", "kubernetes"))])
def test_a_profile_plans_every_job_and_jobs_of_a_cluster_ask_for_gpus_that_this_machine_may_lack(project, profile):
    plugin = PLUGINS.get(profile)
    if plugin and importlib.util.find_spec(plugin) is None:
        pytest.skip(f"needs the plugin of this profile: pip install 'neuspring[{profile}]'")
    output = run(project, {"device": "cuda" if plugin else "cpu"}, "--dry-run", profile=profile)
    assert jobs_in(output) == JOBS
    # search, fit and two of run.
    assert not plugin or output.count("gpu=1") == 4
