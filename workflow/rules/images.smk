# Pictures: splats once per scenario and seed, shared by all methods without splats of their own; drawn and scored per method.
rule appearance:
    input:
        capture=capture_file,
        masks=lambda wildcards: camera_files(wildcards, "masks.json"),
        points=first_points,
    output:
        f"{RESULTS}/{{scenario}}/{{looks}}/{{seed}}/appearance.json",
    log:
        f"{RESULTS}/logs/appearance/{{scenario}}/{{looks}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/appearance/{{scenario}}/{{looks}}/{{seed}}.tsv"
    wildcard_constraints:
        looks=LOOKS,
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=appearance_work,
        gpu=GPU,
        mem_mb=memory("appearance", 8000),
        runtime=minutes("appearance", 240, appearance_work),
    params:
        settings=appearance_settings,
        points=first_points_option,
        images=image_stamps,
        code=code_digest(
            "neuspring.splats.train",
            "neuspring.perception.lift",
            "neuspring.splats.draw",
            stage="stages.appearance.learn",
        ),
    shell:
        gpu_job(
            "appearance --capture {input.capture:q} --masks {input.masks:q} {params.points} {input.points:q}"
            " --settings {params.settings:q} --seed {wildcards.seed} --threads {threads}"
            " --output {output:q}"
        )


rule render:
    input:
        capture=capture_file,
        masks=lambda wildcards: camera_files(wildcards, "masks.json"),
        observations=rules.observe.output,
        appearance=appearance_records,
        rollout=rules.rollout.output,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/render.json",
    log:
        f"{RESULTS}/logs/render/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/render/{{scenario}}/{{method}}/{{seed}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=GPU,
        mem_mb=memory("render", 8000),
        runtime=minutes("render", 120, frame_work),
    params:
        settings=image_settings(
            "backend",
            "views",
            "opacity",
            "frozen_skinning",
            "video",
            "lpips",
            "released_quirks",
        ),
        lpips=lpips_weights(),
        images=image_stamps,
        code=code_digest(
            "neuspring.splats.draw",
            "neuspring.splats.train",
            "neuspring.scores.lpips",
            "neuspring.report.video",
            stage="stages.appearance.render",
        ),
    shell:
        gpu_job(
            "render --capture {input.capture:q} --masks {input.masks:q} --observations {input.observations:q}"
            " --appearance {input.appearance:q} --rollout {input.rollout:q} --settings {params.settings:q}"
            " --threads {threads} --output {output:q}"
        )
