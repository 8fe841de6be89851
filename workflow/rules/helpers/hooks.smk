# What is told before and after a run: the plan, the table of what is finished, failures and what to do next.
def tell_plan():
    """How much time the run is expected to take."""
    slots = {
        "cpu": 0 if CLUSTER else workflow.cores,
        "gpu": workflow.global_resources["gpu"].value if POOL else 0,
    }
    jobs = needs.planned(
        workflow.dag.needrun_jobs(exclude_finished=False), Path(RESULTS)
    )
    print(plan.report(jobs, NEEDS.history, slots), flush=True)
    if GPU and not CLUSTER and not POOL:
        print(
            "There is no GPU here: device: cuda will be refused when this is no dry run."
        )


def refuse_cores_on_a_cluster():
    """With --cores jobs were planned for the GPUs of this machine, which are not those of a cluster."""
    if workflow.non_local_exec and not CLUSTER:
        cause = InputError(
            "--cores",
            "a cluster's scheduler counts cores itself, and gives each job its GPU",
            workflow.resource_settings.cores,
            "Leave it out; --jobs limits how many jobs there are at once.",
        )
        raise WorkflowError(str(cause))


def begin():
    refuse_cores_on_a_cluster()
    begin_run(Path(RESULTS))
    tell_plan()


def tell_plan_of_dry_run():
    # Snakemake has no hook for the end of a dry run.
    if workflow.dryrun and workflow.dag:
        tell_plan()


if workflow.is_main_process:
    atexit.register(tell_plan_of_dry_run)


def tell_failures():
    """What failed and why; the report says the same."""
    damaged = []
    jobs = read_jobs(Path(RESULTS), damaged)
    now = [record for record in jobs if record.last.run == this_run(Path(RESULTS))]
    lines = failure_lines(now, Path(RESULTS)) + damaged
    print("\n".join(["Failed:", *(f"  {line}" for line in lines)] if lines else []))
    if earlier := len(failure_lines(jobs, Path(RESULTS))) + len(damaged) - len(lines):
        print(f"{earlier} jobs that failed in earlier runs have not been run again.")
    print(
        f"Report so far: {TABLE_FOLDER}/so_far/report.html. The same command continues where this one stopped.",
        flush=True,
    )


def report_end(failed):
    """Print the table of what is finished and what to do next, also after an interruption."""
    if failed:
        print("\nThe run did not finish. What is done so far:", flush=True)
        # In a folder of its own: had the tables a file in place, the next run would find nothing to be done.
        command = [sys.executable, "-m", "neuspring", "tables"]
        so_far = f"{TABLE_FOLDER}/so_far"
        subprocess.run([*command, *table_arguments(so_far)], check=False)
        command[-1] = "report"
        page = report_arguments(f"{so_far}/report.html")
        subprocess.run([*command, *page], check=False, stdout=subprocess.DEVNULL)
        tell_failures()
        return
    tell_studies()
    if not Path(TABLES).exists():
        return
    print(f"\n{Path(TABLES).read_text()}")
    print(
        f"Scores, trajectories, plots: {RESULTS}/<scenario>/<method>/<seed>/ (run.json names the twin), tables: {RESULTS}/{CONFIG.tables}/"
    )
    print(
        f"Open in a browser: {REPORT} (everything), {TABLE_FOLDER}/pictures.html (videos of every method)"
    )
    tell_tracking()


def tell_studies():
    """Where the tables beside the paper's are that this run has made."""
    begun = (Path(RESULTS) / FOLDER / RUN).stat().st_mtime
    for name, path in ((name, Path(study_table(name))) for name in BENCHMARK.studies):
        if path.exists() and path.stat().st_mtime >= begun:
            print(
                f"{name}: {path}; the runs behind a number: neuspring explain {name}/ROW/future/chamfer --results {shlex.quote(RESULTS)}"
            )


def tell_tracking():
    if not CONFIG.tracking.enabled:
        return
    neuspring = Path(sys.executable).parent / "neuspring"
    given = (
        f" --settings {shlex.quote(section('tracking'))}" if CONFIG.tracking.uri else ""
    )
    waiting = [
        path
        for path in tracked_runs()
        if Path(path).exists() and "logged" not in Path(path).read_text()
    ]
    if waiting:
        print(
            f"{len(waiting)} runs could not be logged ({Path(waiting[0]).read_text().strip()}). Their records wait on disk; send them:"
        )
        print(f"  {neuspring} sync --results {shlex.quote(RESULTS)}{given}")
    print(
        f"Look at the runs in MLflow:\n  {neuspring} ui --results {shlex.quote(RESULTS)}{given}",
        flush=True,
    )
