# A tuning study: workers share it; each is a job, and the study is as long as the configuration says, however many there are.
if CONFIG.tune:

    rule tune:
        input:
            observations=[
                f"{RESULTS}/{name}/observations.npz" for name in BENCHMARK.tuned
            ],
        output:
            f"{TUNE_FOLDER}/worker-{{worker}}.json",
        log:
            f"{RESULTS}/logs/tune/{CONFIG.tune.study}/{{worker}}.log",
        benchmark:
            f"{RESULTS}/benchmarks/tune/{CONFIG.tune.study}/{{worker}}.tsv"
        wildcard_constraints:
            worker=r"\d+",
        priority: GPU_FIRST
        retries: 2
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            gpu=GPU,
            mem_mb=memory("tune", 8000),
            runtime=2880,
        params:
            settings=tune_settings(),
            rows=tuned_rows(),
            code=code_digest(
                "neuspring.twin.fit", "neuspring.twin.search", stage="experiments.tuning.trial.run"
            ),
        shell:
            common_gpu_job(
                "tune --observations {input.observations:q} --settings {params.settings:q} --worker {wildcards.worker}"
                " --threads {threads} --output {output:q}"
            )

    rule sweep_report:
        input:
            workers=expand(rules.tune.output, worker=range(CONFIG.tune.workers)),
        output:
            sweep_summaries(),
        log:
            f"{RESULTS}/logs/sweep/{CONFIG.tune.study}.log",
        benchmark:
            f"{RESULTS}/benchmarks/sweep/{CONFIG.tune.study}.tsv"
        retries: 2
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            mem_mb=memory("sweep", 4000),
            runtime=minutes("sweep", 20),
        params:
            settings=tune_settings(),
            code=code_digest("neuspring.experiments.tuning.report"),
        shell:
            common_job("tune-report --settings {params.settings:q} --output {output:q}")

    rule log_sweep:
        input:
            store=rules.track_init.output,
            summary=rules.sweep_report.output,
        output:
            f"{TUNE_FOLDER}/mlflow.txt",
        log:
            f"{RESULTS}/logs/log_sweep/{CONFIG.tune.study}.log",
        benchmark:
            f"{RESULTS}/benchmarks/log_sweep/{CONFIG.tune.study}.tsv"
        retries: 2
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            mem_mb=memory("log_sweep", 2000),
            runtime=minutes("log_sweep", 30),
        params:
            settings=section("tracking"),
            results=lambda wildcards, input: str(Path(input.store[0]).parent),
            folder=lambda wildcards, input: str(Path(input.summary[0]).parent),
        shell:
            common_job(
                "sync --results {params.results:q} --under {params.folder:q} --settings {params.settings:q} --output {output:q}"
            )


rule sweep:
    input:
        sweep_targets,
