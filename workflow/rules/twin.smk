# Twins: zero-order stage, first-order stage, prediction; transfer to other recordings.
rule search:
    input:
        observations=rules.observe.output,
        pool=INPUTS.pool,
    output:
        f"{RESULTS}/{{scenario}}/search-{{search}}/{{seed}}/search.json",
    log:
        log_of("search", "{scenario}/{search}/{seed}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("search"),
        mem_mb=NEEDS.memory("search"),
        runtime=NEEDS.minutes("search"),
    params:
        clusters=lambda wildcards: BENCHMARK.searches[wildcards.search].clusters,
        pool=INPUTS.pool_options,
        settings=settings_of("search"),
        code=code_of("search"),
    shell:
        gpu_job(
            "search --observations {input.observations:q} --settings {params.settings:q}"
            " {params.pool} --clusters {params.clusters} --seed {wildcards.seed}"
            f" --twins-per-launch {CONFIG.twins_per_launch} --output {{output:q}}"
        )


# An accelerator alone: its checkpoints, which `fit` continues from, are those that the fits would have left one by one.
rule fits:
    input:
        observations=rules.observe.output,
        searches=INPUTS.searches_of_fits,
    output:
        f"{RESULTS}/{{scenario}}/fits.json",
    log:
        log_of("fits", "{scenario}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("fits"),
        mem_mb=NEEDS.memory("fits"),
        runtime=NEEDS.minutes("fits"),
    params:
        rows=INPUTS.rows_of_fits,
        code=code_of("fits"),
    shell:
        gpu_job(
            "fits --observations {input.observations:q} --rows {params.rows:q}"
            f" --twins-per-launch {CONFIG.twins_per_launch} --output {{output:q}}"
        )


rule fit:
    input:
        observations=rules.observe.output,
        search=INPUTS.search_of_fit,
        pool=INPUTS.pool,
        shared=lambda wildcards: [
            ancient(path) for path in INPUTS.shared_launches(wildcards)
        ],
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/fit.json",
    log:
        log_of("fit", "{scenario}/{method}/{seed}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("fit"),
        mem_mb=NEEDS.memory("fit"),
        runtime=NEEDS.minutes("fit"),
    params:
        kind=lambda wildcards: BENCHMARK.fits[wildcards.method].fit,
        pool=INPUTS.pool_options,
        oracle=lambda wildcards: (
            "--oracle" if BENCHMARK.fits[wildcards.method].oracle else ""
        ),
        settings=settings_of("fit"),
        code=code_of("fit"),
    shell:
        gpu_job(
            "fit --observations {input.observations:q} --search {input.search:q} --settings {params.settings:q}"
            " {params.pool} --kind {params.kind} {params.oracle} --output {output:q}"
        )


rule rollout:
    input:
        observations=rules.observe.output,
        twin=INPUTS.learned,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/rollout.json",
    log:
        log_of("rollout", "{scenario}/{method}/{seed}"),
    wildcard_constraints:
        method=INPUTS.methods(model=False),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("rollout"),
        mem_mb=NEEDS.memory("rollout"),
        runtime=NEEDS.minutes("rollout"),
    params:
        code=code_of("rollout"),
    shell:
        gpu_job(
            "rollout --observations {input.observations:q} --twin {input.twin:q} --output {output:q}"
        )


rule transfer:
    input:
        targets=INPUTS.targets,
        learned=INPUTS.learned,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/transfer.json",
    log:
        log_of("transfer", "{scenario}/{method}/{seed}"),
    priority: GPU_FIRST
    conda:
        ENVIRONMENT
    resources:
        gpu=gpu("transfer"),
        mem_mb=NEEDS.memory("transfer"),
        runtime=NEEDS.minutes("transfer"),
    params:
        settings=settings_of("transfer"),
        code=code_of("transfer"),
    shell:
        gpu_job(
            "transfer --targets {input.targets:q} --twin {input.learned:q} --settings {params.settings:q}"
            " --method {wildcards.method} --seed {wildcards.seed} --output {output:q}"
        )
