rule synthesise:
    output:
        capture=f"{RESULTS}/{{scenario}}/capture/capture.json",
        truth=f"{RESULTS}/{{scenario}}/capture_truth.npz",
    log:
        f"{RESULTS}/logs/capture/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/capture/{{scenario}}.tsv"
    wildcard_constraints:
        scenario=of_source("synthetic"),
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("capture", 4000),
        runtime=minutes("capture", 120, frame_work),
    params:
        settings=section("synthetic"),
        row=scenario_row,
        code=code_digest("neuspring.data.synthetic.make", stage="stages.perceive.make_capture"),
    shell:
        scenario_job(
            "capture --row {params.row:q} --settings {params.settings:q} --output {output.capture:q}"
        )


rule capture:
    input:
        raw_files,
    output:
        f"{RESULTS}/{{scenario}}/capture/capture.json",
    log:
        f"{RESULTS}/logs/capture/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/capture/{{scenario}}.tsv"
    wildcard_constraints:
        scenario=of_source("phystwin_raw", "phystwin"),
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("capture", 4000),
        runtime=minutes("capture", 120, frame_work),
    params:
        settings=section("data_root"),
        row=scenario_row,
        images=image_stamps,
        code=code_digest("neuspring.data.phystwin_raw", stage="stages.perceive.make_capture"),
    shell:
        scenario_job(
            "capture --row {params.row:q} --settings {params.settings:q} --output {output:q}"
        )


rule segment:
    input:
        capture=capture_file,
    output:
        f"{RESULTS}/{{scenario}}/perception/{{camera}}/masks.json",
    log:
        f"{RESULTS}/logs/segment/{{scenario}}/{{camera}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/segment/{{scenario}}/{{camera}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=segment_gpu,
        mem_mb=memory("segment", 8000),
        runtime=minutes("segment", 120, frame_work),
    params:
        settings=segment_settings,
        images=image_stamps,
        code=segment_digest,
    shell:
        gpu_job(
            "segment --capture {input.capture:q} --camera {wildcards.camera} --settings {params.settings:q}"
            " --threads {threads} --output {output:q}"
        )


rule track:
    input:
        capture=capture_file,
        masks=rules.segment.output,
        truth=truth_file("track"),
    output:
        f"{RESULTS}/{{scenario}}/perception/{{camera}}/tracks.json",
    log:
        f"{RESULTS}/logs/track/{{scenario}}/{{camera}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/track/{{scenario}}/{{camera}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=track_gpu(),
        mem_mb=memory("track", 8000),
        runtime=minutes("track", 120, frame_work),
    params:
        settings=perception_settings("track", "seed"),
        images=image_stamps,
        code=backend_digest("track"),
    shell:
        gpu_job(
            "track --capture {input.capture:q} --camera {wildcards.camera} --masks {input.masks:q}"
            " --settings {params.settings:q} --threads {threads} --output {output:q}"
        )


rule lift:
    input:
        capture=capture_file,
        masks=lambda wildcards: camera_files(wildcards, "masks.json"),
        tracks=lambda wildcards: camera_files(wildcards, "tracks.json"),
        truth=truth_file("shape"),
        mesh=CONFIG.perception.shape.mesh or [],
    output:
        f"{RESULTS}/{{scenario}}/perception/lifted.json",
    log:
        f"{RESULTS}/logs/lift/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/lift/{{scenario}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("lift", 8000),
        runtime=minutes("lift", 60, frame_work),
    params:
        settings=perception_settings("lift", "shape"),
        images=image_stamps,
        code=code_digest(
            "neuspring.perception.lift",
            "neuspring.perception.shape_prior",
            stage="stages.perceive.lift",
        ),
    shell:
        scenario_job(
            "lift --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
            " --settings {params.settings:q} --output {output:q}"
        )


rule judge:
    input:
        capture=capture_file,
        masks=lambda wildcards: camera_files(wildcards, "masks.json"),
        tracks=lambda wildcards: camera_files(wildcards, "tracks.json"),
        lifted=rules.lift.output,
        truth=f"{RESULTS}/{{scenario}}/capture_truth.npz",
    output:
        f"{RESULTS}/{{scenario}}/perception/judged.json",
    log:
        f"{RESULTS}/logs/judge/{{scenario}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/judge/{{scenario}}.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        mem_mb=memory("judge", 4000),
        runtime=minutes("judge", 30, frame_work),
    params:
        settings=perception_settings("shape"),
        code=code_digest("neuspring.perception.judge", stage="stages.perceive.judge"),
    shell:
        scenario_job(
            "judge --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
            " --lifted {input.lifted:q} --settings {params.settings:q} --output {output:q}"
        )


rule perception_table:
    input:
        judged_records(),
    output:
        PERCEPTION_TABLE,
    log:
        f"{RESULTS}/logs/{CONFIG.tables}_perception.log",
    benchmark:
        f"{RESULTS}/benchmarks/{CONFIG.tables}_perception.tsv"
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=memory("perception_table", 2000),
        runtime=minutes("perception_table", 10),
    params:
        arguments=perception_arguments(),
        code=code_digest("neuspring.report.tables.perception"),
    shell:
        common_job("perception-table {params.arguments:q} --output {output:q}")
