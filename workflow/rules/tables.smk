rule tables:
    input:
        run_records(),
    output:
        TABLES,
    log:
        f"{RESULTS}/logs/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/tables.tsv"
    conda:
        ENVIRONMENT
    params:
        arguments=table_arguments(),
        code=code_digest("neuspring.tables"),
    retries: 1
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    shell:
        "python -m neuspring tables {params.arguments:q} > {log} 2>&1"
