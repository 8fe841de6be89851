# From raw video to observations, in parallel over the cameras of a scenario.
rule synthesize:
    output:
        capture=f"{RESULTS}/{{scenario}}/capture/capture.json",
        truth=f"{RESULTS}/{{scenario}}/capture_truth.npz",
    log:
        log_of("capture", "{scenario}"),
    wildcard_constraints:
        scenario=INPUTS.scenarios(truth=True),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("capture"),
        runtime=NEEDS.minutes("capture"),
    params:
        row=INPUTS.row,
        settings=settings_of("capture"),
        code=code_of("capture"),
    shell:
        scenario_job(
            "capture --row {params.row:q} --settings {params.settings:q} --output {output.capture:q}"
        )


rule capture:
    input:
        INPUTS.imported_files,
    output:
        f"{RESULTS}/{{scenario}}/capture/capture.json",
    log:
        log_of("capture", "{scenario}"),
    wildcard_constraints:
        scenario=INPUTS.scenarios(imported=True),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("capture"),
        runtime=NEEDS.minutes("capture"),
    params:
        row=INPUTS.row,
        images=INPUTS.image_stamps,
        settings=settings_of("capture"),
        code=code_of("capture"),
    shell:
        scenario_job(
            "capture --row {params.row:q} --settings {params.settings:q} --output {output:q}"
        )


rule segment:
    input:
        capture=INPUTS.capture,
    output:
        f"{RESULTS}/{{scenario}}/perception/{{camera}}/masks.json",
    log:
        log_of("segment", "{scenario}/{camera}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("segment"),
        mem_mb=NEEDS.memory("segment"),
        runtime=NEEDS.minutes("segment"),
    params:
        images=INPUTS.image_stamps,
        settings=settings_of("segment"),
        code=code_of("segment"),
    shell:
        gpu_job(
            "segment --capture {input.capture:q} --camera {wildcards.camera} --settings {params.settings:q} --output {output:q}"
        )


rule track:
    input:
        capture=INPUTS.capture,
        masks=rules.segment.output,
        truth=INPUTS.truth("track"),
    output:
        f"{RESULTS}/{{scenario}}/perception/{{camera}}/tracks.json",
    log:
        log_of("track", "{scenario}/{camera}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("track"),
        mem_mb=NEEDS.memory("track"),
        runtime=NEEDS.minutes("track"),
    params:
        images=INPUTS.image_stamps,
        settings=settings_of("track"),
        code=code_of("track"),
    shell:
        gpu_job(
            "track --capture {input.capture:q} --camera {wildcards.camera} --masks {input.masks:q}"
            " --settings {params.settings:q} --output {output:q}"
        )


rule lift:
    input:
        capture=INPUTS.capture,
        masks=masks_of,
        tracks=tracks_of,
        truth=INPUTS.truth("shape"),
        mesh=CONFIG.perception.shape.mesh or [],
    output:
        f"{RESULTS}/{{scenario}}/perception/lifted.json",
    log:
        log_of("lift", "{scenario}"),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("lift"),
        runtime=NEEDS.minutes("lift"),
    params:
        images=INPUTS.image_stamps,
        settings=settings_of("lift"),
        code=code_of("lift"),
    shell:
        scenario_job(
            "lift --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
            " --settings {params.settings:q} --output {output:q}"
        )


rule judge:
    input:
        capture=INPUTS.capture,
        masks=masks_of,
        tracks=tracks_of,
        lifted=rules.lift.output,
        truth=f"{RESULTS}/{{scenario}}/capture_truth.npz",
    output:
        f"{RESULTS}/{{scenario}}/perception/judged.json",
    log:
        log_of("judge", "{scenario}"),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("judge"),
        runtime=NEEDS.minutes("judge"),
    params:
        settings=settings_of("judge"),
        code=code_of("judge"),
    shell:
        scenario_job(
            "judge --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
            " --lifted {input.lifted:q} --settings {params.settings:q} --output {output:q}"
        )


rule observe:
    input:
        INPUTS.observed_from,
    output:
        f"{RESULTS}/{{scenario}}/observations.npz",
    log:
        log_of("observe", "{scenario}"),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("observe"),
        runtime=NEEDS.minutes("observe"),
    params:
        row=INPUTS.row,
        perceived=lambda wildcards, input: (
            ["--capture", input[0], "--lifted", input[1]]
            if INPUTS.films(wildcards)
            else []
        ),
        settings=settings_of("observe"),
        code=code_of("observe"),
    shell:
        scenario_job(
            "observe --row {params.row:q} --settings {params.settings:q} {params.perceived:q} --output {output:q}"
        )


rule perception_table:
    input:
        [
            f"{RESULTS}/{name}/perception/judged.json"
            for name in INPUTS.judged(CONFIG.scenarios)
        ],
    output:
        PERCEPTION_TABLE,
    log:
        log_of("perception_table", CONFIG.tables),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("perception_table"),
        runtime=NEEDS.minutes("perception_table"),
    params:
        arguments=ARGUMENTS.perception(INPUTS.judged(BENCHMARK.whole.scenarios)),
        code=code_digest("neuspring.report.tables.perception"),
    shell:
        common_job("perception-table {params.arguments:q} --output {output:q}")
