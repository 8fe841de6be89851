# The baselines' models: trained, where there is something to learn, and rolled out over all frames.
rule train:
    input:
        observations=rules.observe.output,
        capture=own_capture,
        masks=own_masks,
        appearance=own_splats,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/train.json",
    log:
        f"{RESULTS}/logs/train/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{scenario}}/{{method}}/{{seed}}.tsv"
    wildcard_constraints:
        method=methods_with("spring_gaus", "gs_dynamics"),
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=train_work,
        gpu=GPU,
        mem_mb=memory("train", 8000),
        runtime=minutes("train", 480, train_work),
    params:
        settings=train_settings,
        model=model_of,
        given=train_options,
        features=feature_weights,
        code=train_digest,
    shell:
        gpu_job(
            "train --observations {input.observations:q} --model {params.model} {params.given:q}"
            " --settings {params.settings:q} --seed {wildcards.seed} --threads {threads}"
            " --output {output:q}"
        )


rule predict:
    input:
        observations=rules.observe.output,
        train=train_records,
        appearance=own_splats,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/rollout.json",
    log:
        f"{RESULTS}/logs/predict/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/predict/{{scenario}}/{{method}}/{{seed}}.tsv"
    wildcard_constraints:
        method=methods_with("spring_gaus", "gs_dynamics", "static", "controller_lbs"),
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=GPU,
        mem_mb=memory("predict", 4000),
        runtime=minutes("predict", 60, frame_work),
    params:
        model=model_of,
        given=predict_options,
        code=predict_digest,
    shell:
        gpu_job(
            "predict --observations {input.observations:q} --model {params.model} {params.given:q}"
            " --threads {threads} --output {output:q}"
        )
