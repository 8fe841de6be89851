# A sweep: workers share one Optuna study; each is a job, and the sweep is as long as the configuration says, however many there are.
SWEEP = GRAPH.sweep_folder
if CONFIG.tune:
    try:
        from neuspring.extensions.tuning import jobs
    except ModuleNotFoundError as error:
        raise WorkflowError(
            "configuration, tune: a sweep needs the extension neuspring/extensions/tuning, which was left out. "
            "Restore its folder, or leave tune out."
        ) from error

    or_workflow_error(jobs.check, BENCHMARK, cluster=CLUSTER)
    TUNED, SWEPT = (
        stamped_job(
            "tune",
            f"{CONFIG.tune.study}/{{worker}}",
            f"{SWEEP}/worker-{{worker}}.json",
            lambda wildcards: [jobs.settings(BENCHMARK), jobs.rows(BENCHMARK)],
            "neuspring.extensions.tuning.trial",
        ),
        stamped_job(
            "sweep",
            CONFIG.tune.study,
            f"{SWEEP}/summary.md",
            lambda wildcards: [jobs.settings(BENCHMARK)],
            "neuspring.extensions.tuning.report",
        ),
    )

    rule tune:
        input:
            observations=[
                f"{RESULTS}/{name}/observations.npz" for name in BENCHMARK.tuned
            ],
            compared=TUNED[1],
        output:
            f"{SWEEP}/worker-{{worker}}.json",
        log:
            TUNED[0],
        wildcard_constraints:
            worker=r"\d+",
        priority: GPU_FIRST
        conda:
            ENVIRONMENT
        resources:
            gpu=GPU,
            mem_mb=NEEDS.memory("tune"),
            runtime=NEEDS.minutes("tune"),
        params:
            settings=jobs.settings(BENCHMARK),
            stamp=TUNED[2],
        shell:
            common_job(
                "tune --observations {input.observations:q} --settings {params.settings:q} --worker {wildcards.worker}"
                f" --threads {{threads}} --device {CONFIG.device} --output {{output:q}}",
                gpus=True,
            )

    rule sweep_report:
        input:
            workers=expand(rules.tune.output, worker=range(CONFIG.tune.workers)),
            compared=SWEPT[1],
        output:
            f"{SWEEP}/summary.md",
        log:
            SWEPT[0],
        conda:
            ENVIRONMENT
        resources:
            mem_mb=NEEDS.memory("sweep"),
            runtime=NEEDS.minutes("sweep"),
        params:
            settings=jobs.settings(BENCHMARK),
            stamp=SWEPT[2],
        shell:
            common_job("tune-report --settings {params.settings:q} --output {output:q}")


rule sweep:
    input:
        lambda wildcards: or_workflow_error(GRAPH.sweep_targets),
