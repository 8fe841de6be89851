# Check the configuration before any job exists, and define the functions of the rules.
import functools
import json
import os
import time
from pathlib import Path

from neuspring import config as settings
from neuspring.cli.main import COMMANDS
from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER
from neuspring.experiments import gpus, job, local, messages, plan
from neuspring.experiments.benchmark import checked, for_targets
from neuspring.experiments.graph import Graph
from neuspring.experiments.tasks import RULES, Tasks

try:
    from neuspring.extensions.tuning import jobs as SWEEPS
except ModuleNotFoundError:
    SWEEPS = None

ROOT = Path(workflow.basedir)
# On a cluster, the scheduler assigns GPUs and Snakemake limits jobs (--jobs), not cores. The chosen executor is not known yet, so
# these settings reveal a cluster. A dry run sets cores to 1; inside a job of the cluster neither is set.
CLUSTER = workflow.remote_exec or (
    workflow.resource_settings.nodes is not None
    and (workflow.resource_settings.cores is None or workflow.output_settings.dryrun)
)
BEGUN = time.time()


def or_workflow_error(check, *arguments, **named):
    """Call a check; its InputError becomes a message without a traceback."""
    try:
        return check(*arguments, **named)
    except InputError as error:
        raise WorkflowError(str(error)) from None


or_workflow_error(local.require_writable)
settings.merge(config, settings.of_command_line(workflow.config_settings.config))
DRY = workflow.output_settings.dryrun
BENCHMARK = or_workflow_error(checked, config, ROOT, plan_only=DRY)
CONFIG = BENCHMARK.config
if CONFIG.tune and SWEEPS:
    or_workflow_error(SWEEPS.check, BENCHMARK, cluster=CLUSTER)
RESULTS = CONFIG.results
POOL = (
    ()
    if CLUSTER
    else or_workflow_error(gpus.pool_of, CONFIG.gpus, CONFIG.device, plan_only=DRY)
)
if not CLUSTER:
    # Without a limit, Snakemake would start jobs that only wait for a GPU.
    limit = workflow.global_resources.get("gpu")
    slots = or_workflow_error(
        gpus.slots_of, POOL, CONFIG.gpus.jobs_per_gpu, limit and limit.value
    )
    if slots:
        workflow.register_resource("gpu", slots)
# Jobs inherit this variable. A cluster assigns the devices of its jobs.
os.environ[job.POOL] = job.GIVEN if CLUSTER else ",".join(POOL)


@functools.cache
def jobs():
    """The jobs of this configuration. Targets that are studies select methods; targets are known only after all rules are read."""
    chosen = for_targets(config, workflow.dag_settings.targets, ROOT)
    benchmark = BENCHMARK
    if chosen:
        config.update(chosen)
        # Jobs of a cluster do not receive the targets, only the configuration.
        words = [
            f"{key}={value if key == 'only' else json.dumps(value)}"
            for key, value in chosen.items()
        ]
        given = workflow.config_settings.config_args or []
        workflow.config_settings.config_args = [*given, *words]
        benchmark = or_workflow_error(checked, config, ROOT, plan_only=DRY)
    graph = Graph(job.with_gpus(benchmark))
    return graph, Tasks(graph, COMMANDS, SWEEPS)


def unit_of(rule, wildcards):
    """The job of a rule with these wildcards."""
    return or_workflow_error(jobs()[0].unit, rule, wildcards.job)


def records(units):
    """The records of the jobs that make these units, which are the outputs of the rules."""
    graph = jobs()[0]
    return [str(graph.record(graph.job_of(unit))) for unit in units]


def needs_of(rule):
    """The input function of a rule."""
    return lambda wildcards: records(unit_of(rule, wildcards).needs)


def target(choose):
    """The input function of a target: print the plan, and request the units that `choose(graph, tasks)` returns."""

    def chosen(wildcards):
        graph, tasks = jobs()
        units = or_workflow_error(choose, graph, tasks)
        RUN["targets"] = RUN.get("targets", []) + list(units)
        if DRY:
            tell_plan()
        return records(units)

    return chosen


RUN = {}


def tell_plan():
    graph = jobs()[0]
    cores = workflow.resource_settings.cores or 1
    files = workflow.config_settings.configfiles
    where = {"gpus": POOL, "cores": cores, "cluster": CLUSTER}
    todo = graph.todo(RUN.get("targets", []))
    print(plan.summary(graph, todo, files, **where), end="", flush=True)


def priority_of(rule):
    """The priority function of a rule: GPU jobs first, then jobs of earlier scenarios."""

    def priority(wildcards):
        graph, unit = jobs()[0], unit_of(rule, wildcards)
        return 10 * graph.gpus(unit) + graph.earliness(unit)

    return priority


def needed_by(rule):
    """Memory, time and GPUs of a rule's jobs, from the declarations of their stages; every attempt requests more."""

    def stages(wildcards):
        # Members of a batch share launches, so the batch requests the time and memory of one member.
        unit = unit_of(rule, wildcards)
        return [step.stage for step in (unit.members or (unit,))[0].steps]

    def memory(wildcards, attempt):
        return attempt * max(
            (stage.memory_mb for stage in stages(wildcards)), default=4000
        )

    def minutes(wildcards, attempt):
        return attempt * (
            sum(stage.minutes for stage in stages(wildcards)) or RULES[rule]
        )

    resources = {"mem_mb": memory, "runtime": minutes}
    if any(stage.gpu for stage in STAGES_OF.get(rule, [])) or "tune" == rule:
        resources["gpu"] = lambda wildcards: jobs()[0].gpus(unit_of(rule, wildcards))
    return resources
