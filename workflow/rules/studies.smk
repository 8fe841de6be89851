# The paper's tables, one per study; rows whose method has not run yet say so.
rule study:
    input:
        lambda wildcards: run_records(BENCHMARK.methods_of(wildcards.study)),
    output:
        f"{TABLE_FOLDER}/studies/{{study}}.md",
    log:
        f"{RESULTS}/logs/study/{CONFIG.tables}/{{study}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/study/{CONFIG.tables}/{{study}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("study", 2000),
        runtime=minutes("study", 10),
    params:
        arguments=study_arguments,
        definition=study_definition,
        code=code_digest("neuspring.report.tables.study"),
    shell:
        common_job("study {params.arguments:q}")


for study_name in BENCHMARK.studies:
    if study_name in {other.name for other in workflow.rules}:
        raise WorkflowError(
            f"{CONFIG.study_table}, study {study_name}: this is the name of another target; rename the study."
        )

    rule:
        name:
            study_name
        input:
            study_table(study_name),
            tracked_runs(BENCHMARK.methods_of(study_name)),
