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
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=4000,
        runtime=120,
    params:
        settings=section("synthetic"),
        row=scenario_row,
        code=code_digest("neuspring.data.synthetic.make", stage="perceive.make_capture"),
    shell:
        "python -m neuspring capture --row {params.row:q} --settings {params.settings:q} --output {output.capture:q}"
        " 2>&1 | tee -a {log:q}"


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
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=4000,
        runtime=120,
    params:
        settings=section("data_root"),
        row=scenario_row,
        images=image_stamps,
        code=code_digest("neuspring.data.phystwin_raw", stage="perceive.make_capture"),
    shell:
        "python -m neuspring capture --row {params.row:q} --settings {params.settings:q} --output {output:q}"
        " 2>&1 | tee -a {log:q}"


rule segment:
    input:
        capture=capture_file,
    output:
        f"{RESULTS}/{{scenario}}/perception/{{camera}}/masks.json",
    log:
        f"{RESULTS}/logs/segment/{{scenario}}/{{camera}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/segment/{{scenario}}/{{camera}}.tsv"
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        device=DEVICE,
        gpu=segment_gpu,
        mem_mb=8000,
        runtime=120,
    params:
        settings=segment_settings,
        images=image_stamps,
        code=segment_digest,
    shell:
        "python -m neuspring segment --capture {input.capture:q} --camera {wildcards.camera} --settings {params.settings:q}"
        " --device {resources.device} --threads {threads} --output {output:q} 2>&1 | tee -a {log:q}"


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
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        device=DEVICE,
        gpu=track_gpu(),
        mem_mb=8000,
        runtime=120,
    params:
        settings=perception_settings("track", "seed"),
        images=image_stamps,
        code=backend_digest("track"),
    shell:
        "python -m neuspring track --capture {input.capture:q} --camera {wildcards.camera} --masks {input.masks:q}"
        " --settings {params.settings:q} --device {resources.device} --threads {threads} --output {output:q} 2>&1 | tee -a {log:q}"


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
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=8000,
        runtime=60,
    params:
        settings=perception_settings("lift", "shape"),
        images=image_stamps,
        code=code_digest(
            "neuspring.perception.lift",
            "neuspring.perception.shape_prior",
            stage="perceive.lift",
        ),
    shell:
        "python -m neuspring lift --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
        " --settings {params.settings:q} --output {output:q} 2>&1 | tee -a {log:q}"


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
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=4000,
        runtime=30,
    params:
        settings=perception_settings("shape"),
        code=code_digest("neuspring.perception.judge", stage="perceive.judge"),
    shell:
        "python -m neuspring judge --capture {input.capture:q} --masks {input.masks:q} --tracks {input.tracks:q}"
        " --lifted {input.lifted:q} --settings {params.settings:q} --output {output:q}"
        " 2>&1 | tee -a {log:q}"


rule perception_table:
    input:
        judged_records(),
    output:
        PERCEPTION_TABLE,
    log:
        f"{RESULTS}/logs/{CONFIG.tables}_perception.log",
    benchmark:
        f"{RESULTS}/benchmarks/{CONFIG.tables}_perception.tsv"
    retries: 1
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=2000,
        runtime=10,
    params:
        arguments=perception_arguments(),
        code=code_digest("neuspring.tables_perception"),
    shell:
        "python -m neuspring perception-table {params.arguments:q} --output {output:q}"
        " > {log:q} 2>&1"
