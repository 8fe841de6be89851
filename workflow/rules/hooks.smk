# What is told before and after a run.
from neuspring.core.job_records import begin_run
from neuspring.experiments import messages


def plan_of_run():
    """How much time the run is expected to take."""
    slots = {
        "cpu": 0 if CLUSTER else workflow.cores,
        "gpu": workflow.global_resources["gpu"].value if POOL else 0,
    }
    jobs = needs.planned(
        workflow.dag.needrun_jobs(exclude_finished=False), Path(RESULTS)
    )
    print(messages.plan(jobs, NEEDS.history, slots), flush=True)
    if GPU and not CLUSTER and not POOL:
        print(
            "There is no GPU here: device: cuda will be refused when this is no dry run."
        )
    return jobs


def begin():
    if workflow.non_local_exec and not CLUSTER:
        # Jobs were planned for the GPUs of this machine, which are not those of a cluster.
        reason = "a cluster's scheduler counts cores itself, and gives each job its GPU"
        remedy = "Leave it out; --jobs limits how many jobs there are at once."
        raise WorkflowError(
            str(InputError("--cores", reason, workflow.resource_settings.cores, remedy))
        )
    begin_run(Path(RESULTS))
    plan_of_run()


def plan_of_dry_run():
    # Snakemake has no hook for the end of a dry run.
    if workflow.dryrun and workflow.dag:
        plan_of_run()


if workflow.is_main_process:
    atexit.register(plan_of_dry_run)


def finish():
    messages.finished(BENCHMARK, ARGUMENTS, INPUTS.logged_runs())


def give_up():
    messages.failed(BENCHMARK, ARGUMENTS)
