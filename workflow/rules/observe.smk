rule observe:
    input:
        scenario_files,
    output:
        f"{RESULTS}/{{scenario}}/observations.npz",
    log:
        f"{RESULTS}/logs/observe/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/observe/{{scenario}}.tsv"
    conda:
        ENVIRONMENT
    params:
        settings=observe_settings,
        row=scenario_row,
        code=reader_digest,
    retries: 1
    threads: 1
    resources:
        mem_mb=4000,
        runtime=30,
    shell:
        "python -m neuspring observe --scenario {wildcards.scenario} --settings {params.settings:q} --output {output}"
        " 2>&1 | tee {log}"
