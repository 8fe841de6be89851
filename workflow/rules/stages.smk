# One rule per stage. What a job reads stands in the signature of its function, neuspring/stages/<rule>.py; where that lies, what its
# options are and what makes it run again follows from its declarations: neuspring/experiments/graph.py.
for STAGE in STAGES.values():
    # Snakemake reads the text of a command once more when a job runs, where `rule` is the job's and STAGE the last one.
    globals()["rule"] = STAGE.name

    rule:
        name:
            STAGE.name
        input:
            unpack(compared_with_records(STAGE)),
            **shared_launches(STAGE),
        output:
            f"{RESULTS}/{STAGE.output}",
        log:
            log_of(STAGE.name, STAGE.job_name),
        wildcard_constraints:
            **GRAPH.constraints(STAGE),
        priority: priority_of(STAGE)
        conda:
            ENVIRONMENT
        resources:
            **({"gpu": GRAPH.gpu(STAGE)} if STAGE.gpu else {}),
            mem_mb=NEEDS.memory(STAGE.name),
            runtime=NEEDS.minutes(STAGE.name),
        params:
            command=GRAPH.command(STAGE),
            stamp=GRAPH.stamp(STAGE),
        shell:
            stage_job(STAGES[rule])
