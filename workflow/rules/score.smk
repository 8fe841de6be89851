rule score:
    input:
        observations=rules.observe.output,
        search=search_records,
        fit=fit_records,
        train=train_records,
        rollout=rules.rollout.output,
        appearance=appearance_records,
        render=render_records,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/run.json",
    log:
        f"{RESULTS}/logs/score/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/score/{{scenario}}/{{method}}/{{seed}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("score", 4000),
        runtime=minutes("score", 30, frame_work),
    params:
        stages=stage_options,
        pictures=picture_options,
        variant=variant,
        code=code_digest("neuspring.scores.metrics", "neuspring.report.figures.run", stage="stages.stages.score"),
    shell:
        scenario_job(
            "score --observations {input.observations:q} {params.stages:q}"
            " --rollout {input.rollout:q} {params.pictures:q} --method {wildcards.method} --variant {params.variant:q} --seed {wildcards.seed}"
            " --output {output:q}"
        )
