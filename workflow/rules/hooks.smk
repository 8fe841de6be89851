# What is told before, during and after a run; the warm process of its jobs.
import time
from collections import Counter
from types import SimpleNamespace

from neuspring.core.job_records import begin_run
from neuspring.core.text import program
from neuspring.experiments import messages, plan

RUN = SimpleNamespace(begun=0.0, overview=None, warm=None)


def tell_what_is_made_again():
    """Which results are replaced although they are there, and why."""
    jobs = workflow.dag.needrun_jobs(exclude_finished=False)
    found = [
        (job, FRESH.departures.get(str(job.output[0]))) for job in jobs if job.output
    ]
    print(
        messages.replaced(
            [(job.rule.name, job.wildcards, why) for job, why in found if why]
        ),
        end="",
        flush=True,
    )


def tell_plan():
    """What the jobs will take, where, what is missing, and where the tables will be."""
    jobs = workflow.dag.needrun_jobs(exclude_finished=False)
    place = plan.Place(
        gpus=POOL, cores=workflow.resource_settings.cores or 1, cluster=CLUSTER
    )
    counts = Counter(job.rule.name for job in jobs)
    files = workflow.config_settings.configfiles
    print(plan.told(GRAPH, NEEDS, counts, place, files), end="", flush=True)


def begin():
    if workflow.non_local_exec and not CLUSTER:
        # Jobs were planned for the GPUs of this machine, which are not those of a cluster.
        reason = "a cluster's scheduler counts cores itself, and gives each job its GPU"
        remedy = "Leave it out; --jobs limits how many jobs there are at once."
        raise WorkflowError(
            str(InputError("--cores", reason, workflow.resource_settings.cores, remedy))
        )
    chosen = {
        name: list(getattr(CONFIG, name)) for name in ("scenarios", "methods", "seeds")
    }
    command = [program("snakemake"), *sys.argv[1:]]
    begin_run(Path(RESULTS), {"command": command, "only": CONFIG.only, **chosen})
    tell_what_is_made_again()
    tell_plan()
    RUN.begun = time.monotonic()
    if QUIET:
        jobs = [
            job
            for job in workflow.dag.needrun_jobs(exclude_finished=False)
            if len(job.log)
        ]
        RUN.overview = messages.Overview(
            Path(RESULTS), [Path(job.log[0]) for job in jobs]
        )
        RUN.overview.start()
    if not CLUSTER:
        WARM.parent.mkdir(mode=0o700)
        RUN.warm = warm.serve_while_running(WARM)


def end():
    if RUN.overview:
        RUN.overview.stop()
    if RUN.warm:
        RUN.warm.stdin.close()
        RUN.warm.wait()


def end_of_dry_run():
    # Snakemake has no hook for it.
    if workflow.dryrun and workflow.dag:
        tell_what_is_made_again()
        tell_plan()


if workflow.is_main_process:
    atexit.register(end_of_dry_run)


def finish():
    end()
    messages.finished(GRAPH, time.monotonic() - RUN.begun)


def give_up():
    end()
    messages.failed(GRAPH)
