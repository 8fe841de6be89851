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
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("tables", 2000),
        runtime=minutes("tables", 10),
    params:
        arguments=table_arguments(),
        code=code_digest("neuspring.report.tables.summary", "neuspring.report.gallery"),
    shell:
        common_job("tables {params.arguments:q}")


rule report:
    input:
        tables=TABLES,
        studies=[study_table(name) for name in CONFIG.studies],
        perception=perception_tables(),
    output:
        REPORT,
    log:
        f"{RESULTS}/logs/report/{CONFIG.tables}.log",
    benchmark:
        f"{RESULTS}/benchmarks/report/{CONFIG.tables}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("report", 4000),
        runtime=minutes("report", 20),
    params:
        arguments=report_arguments(),
        templates=template_digest(),
        sweeps=finished_sweeps(),
        code=code_digest("neuspring.report.page"),
    shell:
        common_job("report {params.arguments:q}")
