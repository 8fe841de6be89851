rule observe:
    input:
        scenario_files,
    output:
        f"{RESULTS}/{{scenario}}/observations.npz",
    log:
        f"{RESULTS}/logs/observe/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/observe/{{scenario}}.tsv"
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=observe_settings,
        row=scenario_row,
        code=reader_digest,
        perceived=perceived_options,
    shell:
        "python -m neuspring observe --row {params.row:q} --settings {params.settings:q} {params.perceived:q} --output {output:q}"
        " 2>&1 | tee -a {log:q}"
