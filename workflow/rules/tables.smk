rule tables:
    input:
        runs=run_records(),
        transfers=transfer_records(),
    output:
        TABLES,
    log:
        f"{RESULTS}/logs/{CONFIG.tables}.log",
    benchmark:
        f"{RESULTS}/benchmarks/{CONFIG.tables}.tsv"
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        arguments=table_arguments(),
        code=code_digest("neuspring.tables", "neuspring.gallery"),
    shell:
        "python -m neuspring tables {params.arguments:q} > {log:q} 2>&1"
