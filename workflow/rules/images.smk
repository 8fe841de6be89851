# Pictures: splats once per scenario and seed, shared by all methods without splats of their own; rendered and scored per method.
rule appearance:
    input:
        capture=INPUTS.capture,
        masks=masks_of,
        points=INPUTS.first_points,
    output:
        f"{RESULTS}/{{scenario}}/{{looks}}/{{seed}}/appearance.json",
    log:
        log_of("appearance", "{scenario}/{looks}/{seed}"),
    wildcard_constraints:
        looks=INPUTS.splat_folders,
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("appearance"),
        mem_mb=NEEDS.memory("appearance"),
        runtime=NEEDS.minutes("appearance"),
    params:
        points=lambda wildcards: (
            "--lifted" if INPUTS.films(wildcards) else "--observations"
        ),
        images=INPUTS.image_stamps,
        settings=settings_of("appearance"),
        code=code_of("appearance"),
    shell:
        gpu_job(
            "appearance --capture {input.capture:q} --masks {input.masks:q} {params.points} {input.points:q}"
            " --settings {params.settings:q} --seed {wildcards.seed} --output {output:q}"
        )


rule render:
    input:
        capture=INPUTS.capture,
        masks=masks_of,
        observations=rules.observe.output,
        appearance=INPUTS.appearance,
        rollout=rules.rollout.output,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/render.json",
    log:
        log_of("render", "{scenario}/{method}/{seed}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("render"),
        mem_mb=NEEDS.memory("render"),
        runtime=NEEDS.minutes("render"),
    params:
        lpips=INPUTS.lpips(),
        images=INPUTS.image_stamps,
        settings=settings_of("render"),
        code=code_of("render"),
    shell:
        gpu_job(
            "render --capture {input.capture:q} --masks {input.masks:q} --observations {input.observations:q}"
            " --appearance {input.appearance:q} --rollout {input.rollout:q} --settings {params.settings:q} --output {output:q}"
        )
