# MLflow is an index of the records: these rules never fail a run, and nothing numerical depends on them.
rule track_init:
    output:
        f"{RESULTS}/mlflow.json",
    log:
        f"{RESULTS}/logs/track_init.log",
    benchmark:
        f"{RESULTS}/benchmarks/track_init.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("track_init", 2000),
        runtime=minutes("track_init", 10),
    params:
        settings=section("tracking"),
        results=lambda wildcards, output: str(Path(output[0]).parent),
    shell:
        common_job(
            "track-init --results {params.results:q} --settings {params.settings:q} --output {output:q}"
        )


rule log_run:
    input:
        store=rules.track_init.output,
        record=rules.score.output,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/mlflow.txt",
    log:
        f"{RESULTS}/logs/log_run/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/log_run/{{scenario}}/{{method}}/{{seed}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("log_run", 2000),
        runtime=minutes("log_run", 10, frame_work),
    params:
        settings=section("tracking"),
        results=lambda wildcards, input: str(Path(input.store[0]).parent),
    shell:
        scenario_job(
            "log --record {input.record:q} --results {params.results:q} --settings {params.settings:q}"
            " --output {output:q}"
        )
