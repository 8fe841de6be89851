# The baselines' models: trained, where there is something to learn, and rolled out over all frames.
rule train:
    input:
        observations=rules.observe.output,
        capture=files_if(INPUTS.pictured, INPUTS.capture),
        masks=files_if(INPUTS.pictured, masks_of),
        appearance=files_if(INPUTS.pictured, INPUTS.appearance),
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/train.json",
    log:
        log_of("train", "{scenario}/{method}/{seed}"),
    wildcard_constraints:
        method=INPUTS.methods(model=True, trained=True),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("train"),
        mem_mb=NEEDS.memory("train"),
        runtime=NEEDS.minutes("train"),
    params:
        model=lambda wildcards: BENCHMARK.methods[wildcards.method].model,
        pictures=lambda wildcards, input: options(
            input, capture="--capture", masks="--masks", appearance="--appearance"
        ),
        features=INPUTS.features,
        settings=settings_of("train"),
        code=code_of("train"),
    shell:
        gpu_job(
            "train --observations {input.observations:q} --model {params.model} {params.pictures:q}"
            " --settings {params.settings:q} --seed {wildcards.seed} --output {output:q}"
        )


rule predict:
    input:
        observations=rules.observe.output,
        train=INPUTS.train,
        appearance=files_if(INPUTS.pictured, INPUTS.appearance),
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/rollout.json",
    log:
        log_of("predict", "{scenario}/{method}/{seed}"),
    wildcard_constraints:
        method=INPUTS.methods(model=True),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("predict"),
        mem_mb=NEEDS.memory("predict"),
        runtime=NEEDS.minutes("predict"),
    params:
        model=lambda wildcards: BENCHMARK.methods[wildcards.method].model,
        learned=lambda wildcards, input: options(
            input, train="--train", appearance="--appearance"
        ),
        code=code_of("predict"),
    shell:
        gpu_job(
            "predict --observations {input.observations:q} --model {params.model} {params.learned:q} --output {output:q}"
        )
