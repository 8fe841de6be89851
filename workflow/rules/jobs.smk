# One rule per kind of job. What a job runs and reads follows from declarations of stages: neuspring/experiments/graph.py. The name of
# its record has the digest of its settings, code and inputs, so that Snakemake finds what is finished by the file alone: results may
# be copied or moved.
STAGES_OF = Graph(BENCHMARK).rules

for RULE in (*STAGES_OF, *(name for name in RULES if name not in STAGES_OF)):

    rule:
        name:
            RULE
        input:
            needs_of(RULE),
        output:
            f"{RESULTS}/{FOLDER}/{RULE}/{{job}}/{{digest}}.json",
        log:
            f"{RESULTS}/{FOLDER}/{RULE}/{{job}}/{{digest}}.log",
        benchmark:
            f"{RESULTS}/{FOLDER}/{RULE}/{{job}}/{{digest}}.tsv"
        wildcard_constraints:
            digest="[0-9a-f]{16}",
        # GPU jobs first, so that CPU jobs cannot starve a GPU; then those of earlier scenarios.
        priority: priority_of(RULE)
        # On a cluster it is the main process that tries again: inside a submitted job retries would multiply.
        retries: 0 if workflow.remote_exec else 1
        conda:
            str(ROOT / "workflow" / "envs" / "neuspring.yaml")
        resources:
            **needed_by(RULE),
        params:
            digest=lambda wildcards: wildcards.digest,
        script:
            "../scripts/job.py"
