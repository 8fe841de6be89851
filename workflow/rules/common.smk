# Checks the configuration before any job exists, and defines the helper functions of the rules.
import atexit
import gc
import json
import logging
import shlex
import sys
import tempfile
import uuid
from pathlib import Path

from snakemake.cli import get_argument_parser
from snakemake.logging import logger

from neuspring import config as settings
from snakemake.settings.enums import RerunTrigger
from snakemake_interface_logger_plugins.common import LogEvent

from neuspring.core.errors import InputError
from neuspring.experiments import needs
from neuspring.experiments.benchmark import for_targets
from neuspring.experiments.freshness import Freshness, stamp_of, stamped
from neuspring.experiments.graph import Graph
from neuspring.experiments.jobs import warm, wrapper
from neuspring.stages import STAGES

# The graph of jobs stays until the end. To look for garbage in it again and again, at last at the exit, is a fifth of a dry run.
gc.set_threshold(100_000, 50, 100)
atexit.register(gc.freeze)

ROOT = Path(workflow.basedir)
# On a cluster the scheduler hands out GPUs, and Snakemake limits jobs (--jobs), not cores. A dry run sets cores to 1; inside a job of
# the cluster neither is set. Which executor was asked for is not known yet.
CLUSTER = workflow.remote_exec or (
    workflow.resource_settings.nodes is not None
    and (workflow.resource_settings.cores is None or workflow.output_settings.dryrun)
)


# `--quiet all`: jobs write to their logs alone, and a line per finished job is told. Snakemake would then hide errors too.
QUIET = "all" in {level.name.lower() for level in workflow.output_settings.quiet or ()}
if QUIET:
    errors = logging.StreamHandler()
    errors.setLevel(logging.ERROR)
    # Of a job that failed its wrapper says why in a line. Snakemake would print its command, which holds all settings.
    errors.addFilter(
        lambda record: (
            getattr(record, "event", None) != LogEvent.JOB_ERROR
            and "CalledProcessError" not in record.getMessage()
        )
    )
    errors.setFormatter(next(each.formatter for each in logger.handlers))
    logger.addHandler(errors)


def or_workflow_error(check, *arguments, **named):
    """What a check returns; a clear message and no traceback where it refuses."""
    try:
        return check(*arguments, **named)
    except InputError as error:
        raise WorkflowError(str(error)) from None


settings.merge(config, settings.of_command_line(workflow.config_settings.config))
# A target that is a study chooses methods. Snakemake knows the targets only when the rules are there, so they are read from the command
# line. Jobs of a cluster are not told them, but what follows from them.
TARGETS = (
    get_argument_parser().parse_args(sys.argv[1:]).targets
    if workflow.is_main_process and Path(sys.argv[0]).stem in ("snakemake", "__main__")
    else []
)
CHOSEN = or_workflow_error(for_targets, config, TARGETS, ROOT)
config.update(CHOSEN)
workflow.config_settings.config_args = [
    *(workflow.config_settings.config_args or []),
    *(
        f"{key}={value if key == 'only' else json.dumps(value)}"
        for key, value in CHOSEN.items()
    ),
]
BENCHMARK = or_workflow_error(
    needs.checked, config, ROOT, plan_only=workflow.output_settings.dryrun
)
CONFIG = BENCHMARK.config
RESULTS = CONFIG.results
POOL = () if CLUSTER else or_workflow_error(needs.pool_of, CONFIG, workflow)
GPU = int(
    CONFIG.device == "cuda" or (CONFIG.device == "auto" and (CLUSTER or bool(POOL)))
)
BENCHMARK.on_gpu = bool(GPU)
BENCHMARK.gpu_slots = len(POOL) * CONFIG.gpus.jobs_per_gpu
GRAPH = Graph(BENCHMARK)
FRESH = Freshness(GRAPH)
NEEDS = needs.Needs(BENCHMARK, "gpu" if GPU else "cpu")
# No GPU waits for one of its jobs while cores are taken by jobs that need none.
GPU_FIRST = 10 * GPU
# Only for `--software-deployment-method conda`; without it the running environment is used.
ENVIRONMENT = str(ROOT / "workflow" / "envs" / "neuspring.yaml")
# Where jobs find the warm process of this run.
WARM = Path(tempfile.gettempdir()) / f"neuspring-{uuid.uuid4().hex[:16]}" / "socket"
TABLES = f"{GRAPH.folder}/summary.md"
REPORT = f"{GRAPH.folder}/report.html"
PERCEPTION_TABLE = f"{GRAPH.folder}/perception.md"


def job_prefix():
    """What every job's shell begins with: the interpreter that runs Snakemake (unless conda provides one) and the GPUs to share.

    A prefix replaces Snakemake's own, without which a command that fails before a pipe would count as one that succeeded.
    """
    values = {
        # Only inside a job that a cluster started; with --jobs beside --cores Snakemake runs jobs here.
        wrapper.POOL: wrapper.GIVEN if workflow.remote_exec else ",".join(POOL),
        wrapper.GPU_SHARE: str(CONFIG.gpus.jobs_per_gpu),
    }
    if not CLUSTER:
        values[warm.SOCKET] = str(WARM)
    exports = "".join(
        f"export {name}={shlex.quote(value)}; " for name, value in values.items()
    )
    if not workflow.deployment_settings.deployment_method:
        exports += (
            f"export PATH={shlex.quote(str(Path(sys.executable).parent))}:$PATH; "
        )
    return f"set -euo pipefail; {exports}"


shell.prefix(job_prefix())


wildcard_constraints:
    **GRAPH.wildcards,


def priority_of(stage):
    """Jobs for a GPU first, then those of earlier scenarios: the first scenario is finished long before the last one."""
    first = GPU_FIRST if stage.gpu else 0
    return lambda wildcards: first + GRAPH.earliness(wildcards.scenario)


def log_of(stage, name):
    """The log of a job; its record has the same name (`neuspring.core.job_records`)."""
    return f"{RESULTS}/logs/{stage}/{name}.log"


def section(name):
    """A section of the configuration, as the JSON text that a command takes."""
    return json.dumps({name: settings.plain(CONFIG)[name]}, sort_keys=True)


def made_again(output, departures):
    """Makes a job run whose output is there but departs from what it would be now, whatever Snakemake remembers of it.

    Input functions ask for this: they are called for every job of the DAG, before Snakemake decides which of them run. With
    `--rerun-triggers mtime` results are taken as they are.
    """
    asked = RerunTrigger.PARAMS in workflow.rerun_triggers
    if departures and asked and workflow.is_main_process:
        FRESH.departures[output] = departures
        workflow.dag.forcefiles.add(output)


def compared_with_records(stage):
    """The input function of a stage, which compares its record on the way."""
    find = GRAPH.inputs(stage)

    def found(wildcards):
        output = GRAPH.output_of(stage, wildcards)
        made_again(output, FRESH.look(stage, wildcards))
        if stage.together and workflow.is_main_process:
            # Launches are shared again if some job that takes part is to be done, and in no other case.
            member = STAGES[stage.together.stage]
            if any(unfinished(member, one) for one in GRAPH.in_step(stage, wildcards)):
                workflow.dag.forcefiles.add(output)
        return find(wildcards)

    return found


def unfinished(stage, wildcards):
    """Whether what a job makes is not there, or departs from what it would make now."""
    there = Path(GRAPH.output_of(stage, wildcards)).exists()
    return not there or bool(FRESH.look(stage, wildcards))


def shared_launches(stage):
    """The record of the launches that a job shared with others, as an input of a stage whose jobs may be done together.

    Their checkpoints, from which a job goes on, are those that it would have left alone. But behind a job that is made again Snakemake
    overlooks what is missing, if all that it reads is ancient. A finished job waits for no record that is only made now: Snakemake takes
    what is ancient and absent for a reason to make the job again.
    """

    def found(wildcards):
        paths = GRAPH.shared_launches(stage, wildcards)
        if unfinished(stage, wildcards):
            return paths
        return [ancient(path) for path in paths if Path(path).exists()]

    return {"shared": found} if GRAPH.together(stage) else {}


def compared_with_stamp(log, output, stamp):
    """An input function without files, of jobs of no stage. It compares the stamp in the record of the last such job."""

    def nothing(wildcards):
        path, names = Path(output.format(**wildcards)), dict(wildcards)
        if path.exists() and not stamped(
            Path(RESULTS), Path(log.format(**names)), stamp(wildcards)
        ):
            made_again(str(path), ("what it was told, or its code",))
        return []

    return nothing


def stamped_job(rule, name, output, told, *modules):
    """Of jobs of no stage: their log, the input function that compares their stamp, and the stamp.

    The stamp is of what a job is told (wildcards -> words) and of the code of modules; its record holds it.
    """

    def stamp(wildcards):
        return stamp_of(RESULTS, ROOT, told(wildcards), *modules)

    log = log_of(rule, name)
    return log, compared_with_stamp(log, output, stamp), stamp


def wrapped(flags, command):
    """A command in the wrapper that every job runs in: GPU lease, log, record, cause of failure."""
    quiet = "--quiet " if QUIET and "--quiet" not in flags else ""
    return f"python -m {wrapper.__name__} --log {{log:q}} {quiet}{flags} -- python -m neuspring {command}"


def common_job(command, gpus=False):
    """A job of no scenario."""
    flags = "--gpus {resources.gpu}" if gpus else "--quiet"
    return wrapped(f"{flags} --stamp {{params.stamp}}", command)


def stage_job(stage):
    """A job of a stage: its command, and where it runs, which changes no result and so runs nothing again."""
    places = {
        "device": CONFIG.device,
        "threads": "{threads}",
        "twins_per_launch": CONFIG.twins_per_launch,
    }
    where = [f"--{name.replace('_', '-')} {places[name]}" for name in stage.places]
    gpus = "--gpus {resources.gpu}" if stage.gpu else ""
    return wrapped(
        f"--scenario {{wildcards.scenario}} {gpus}",
        " ".join(["{params.command}", *where, "--output {output:q}"]),
    )
