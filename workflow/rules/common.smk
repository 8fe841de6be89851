# Validates the configuration before any job, and holds the helpers that rules use.
import atexit
import functools
import gc
import hashlib
import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

from neuspring.experiments import benchmark as benchmarks
from neuspring import config as settings
from neuspring.config import baselines as config_baselines
from neuspring.experiments.jobs import gpus
from neuspring.experiments.jobs import wrapper as job
from neuspring.experiments import needs
from neuspring.experiments import plan
from neuspring.experiments.tuning import space as tune_space
from neuspring.baselines.spring_gaus import vgg16_weights
from neuspring.data import phystwin, phystwin_raw
from neuspring.core.errors import InputError
from neuspring.core.job_records import (
    FOLDER,
    RUN,
    begin_run,
    failure_lines,
    read_jobs,
    this_run,
)
from neuspring.scores.lpips_weights import configured
from neuspring.core.provenance import code_digest

# The graph of jobs stays until the end. To look for garbage in it again and again, at last at the exit, is a fifth of a dry run.
gc.set_threshold(100_000, 50, 100)
atexit.register(gc.freeze)

ROOT = Path(workflow.basedir)
# On a cluster its scheduler hands out GPUs; Snakemake then counts jobs (--jobs), not cores, but for a dry run, where it makes cores 1.
# Inside one of its jobs nothing is counted. Which executor was asked for is not known yet.
CLUSTER = workflow.remote_exec or (
    workflow.resource_settings.nodes is not None
    and (workflow.resource_settings.cores is None or workflow.output_settings.dryrun)
)


def checked_benchmark():
    """The validated configuration; a clear message and no traceback if it is wrong or the results folder is not writable."""
    try:
        benchmark = benchmarks.Benchmark.of(config, ROOT)
        if benchmark.config.tune:
            tune_space.Plan.of(benchmark.config, benchmark.config.tune, ROOT)
            needs.check_storage(benchmark.config.tune, cluster=CLUSTER)
        results = Path(benchmark.config.results)
        try:
            results.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=results).close()
        except OSError as error:
            raise InputError(
                f"configuration, results ({results})",
                "this folder must be writable",
                error.strerror,
                "Choose another: --config results=...",
            ) from error
        return benchmark
    except InputError as error:
        raise WorkflowError(str(error)) from None


BENCHMARK = checked_benchmark()
CONFIG = BENCHMARK.config
RESULTS = CONFIG.results
DEVICE = CONFIG.device


def checked_pool():
    """The GPUs of this machine that jobs lease. Too large a wish is an error here, before any job: Snakemake would clamp it."""
    if CLUSTER:
        return ()
    wanted = workflow.global_resources.get("gpu")
    limit = wanted.value if wanted else None
    try:
        dryrun = workflow.output_settings.dryrun
        pool = needs.gpu_pool(CONFIG.gpus, DEVICE, plan_only=dryrun)
        overwritten = workflow.resource_settings.overwrite_resources
        needs.check_gpus(overwritten, pool)
        if pool:
            slots = needs.gpu_slots(pool, CONFIG.gpus.jobs_per_gpu, limit)
            workflow.register_resource("gpu", slots)
        elif limit:
            raise InputError(
                "--resources gpu",
                "no job of this run can have a GPU",
                limit,
                "Leave it out, or set device: cuda where there is one.",
            )
    except InputError as error:
        raise WorkflowError(str(error)) from None
    return pool


POOL = checked_pool()
GPU = int(DEVICE == "cuda" or (DEVICE == "auto" and (CLUSTER or bool(POOL))))
NEEDS = needs.Needs(BENCHMARK, "gpu" if GPU else "cpu")
memory, search_work, fit_work = NEEDS.memory, NEEDS.search, NEEDS.fit
train_work = NEEDS.train
appearance_work, frame_work = NEEDS.appearance, NEEDS.scenario


def job_prefix():
    """What every job's shell begins with: the interpreter that runs Snakemake (unless conda provides one) and the GPUs to share.

    A prefix replaces Snakemake's own, without which a command that fails before a pipe would count as one that succeeded.
    """
    values = {
        # Only inside a job that a cluster started; with --jobs beside --cores Snakemake runs jobs here.
        job.POOL: job.GIVEN if workflow.remote_exec else ",".join(POOL),
        job.SHARE: str(CONFIG.gpus.jobs_per_gpu),
    }
    exports = "".join(
        f"export {name}={shlex.quote(value)}; " for name, value in values.items()
    )
    if not workflow.deployment_settings.deployment_method:
        exports += (
            f"export PATH={shlex.quote(str(Path(sys.executable).parent))}:$PATH; "
        )
    return f"set -euo pipefail; {exports}"


shell.prefix(job_prefix())


def wrapped(options, command):
    """A `neuspring` command in the wrapper that every job runs in: GPU lease, log, record, cause of failure (`neuspring.experiments.jobs.wrapper`)."""
    run = "python -m neuspring.experiments.jobs.wrapper --log {log:q}"
    return f"{run} {options} -- python -m neuspring {command}"


def common_job(command):
    return wrapped("--quiet", command)


def common_gpu_job(command):
    return wrapped("--gpus {resources.gpu}", f"{command} --device {DEVICE}")


def scenario_job(command):
    return wrapped("--scenario {wildcards.scenario} --work {resources.work}", command)


def gpu_job(command):
    return wrapped(
        "--scenario {wildcards.scenario} --work {resources.work} --gpus {resources.gpu}",
        f"{command} --device {DEVICE}",
    )


# No GPU waits for one of its jobs while cores are taken by jobs that need none.
GPU_FIRST = 10 * GPU


def one(wildcards):
    return 1


def minutes(rule, default, work=None):
    return NEEDS.minutes(rule, default, work or one)


TABLE_FOLDER = f"{RESULTS}/{CONFIG.tables}"
TABLES = f"{TABLE_FOLDER}/summary.md"
REPORT = f"{TABLE_FOLDER}/report.html"
PERCEPTION_TABLE = f"{TABLE_FOLDER}/perception.md"


# Only for `--software-deployment-method conda`; without it the running environment is used.
ENVIRONMENT = str(ROOT / "workflow" / "envs" / "neuspring.yaml")


wildcard_constraints:
    scenario="|".join(map(re.escape, BENCHMARK.scenarios)),
    method="|".join(map(re.escape, BENCHMARK.methods | BENCHMARK.fits)),
    search="|".join(map(re.escape, BENCHMARK.searches)),
    camera=r"[A-Za-z0-9][A-Za-z0-9_.-]*",
    seed="|".join(map(str, BENCHMARK.whole.seeds)),
    study="|".join(map(re.escape, BENCHMARK.studies)),


def section(*names):
    """Sections of the configuration as the JSON text that a command takes."""
    return json.dumps(
        {name: settings.plain(CONFIG)[name] for name in names}, sort_keys=True
    )
