# One rule per kind of job. neuspring/experiments/graph.py derives steps and inputs of a job from the declarations of stages. The
# name of its record contains the digest of settings, code and inputs, so Snakemake recognizes finished jobs by file name, also
# after results were copied or moved.
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
        # GPU jobs get priority, so CPU jobs cannot starve a GPU; then jobs of earlier scenarios.
        priority: priority_of(RULE)
        # On a cluster only the main process retries, because retries inside submitted jobs would multiply.
        retries: 0 if workflow.remote_exec else 1
        conda:
            str(ROOT / "workflow" / "envs" / "neuspring.yaml")
        resources:
            **needed_by(RULE),
        params:
            digest=lambda wildcards: wildcards.digest,
        script:
            "../scripts/job.py"
