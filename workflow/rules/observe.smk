rule observe:
    input:
        scenario_files,
    output:
        f"{RESULTS}/{{scenario}}/observations.npz",
    log:
        f"{RESULTS}/logs/observe/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/observe/{{scenario}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("observe", 4000),
        runtime=minutes("observe", 30, frame_work),
    params:
        settings=observe_settings,
        row=scenario_row,
        code=reader_digest,
        perceived=perceived_options,
    shell:
        scenario_job(
            "observe --row {params.row:q} --settings {params.settings:q} {params.perceived:q} --output {output:q}"
        )
