rule search:
    input:
        observations=rules.observe.output,
    output:
        f"{RESULTS}/{{scenario}}/search-{{search}}/{{seed}}/search.json",
    log:
        f"{RESULTS}/logs/search/{{scenario}}/{{search}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/search/{{scenario}}/{{search}}/{{seed}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=search_work,
        gpu=GPU,
        mem_mb=memory("search", 8000),
        runtime=minutes("search", 240, search_work),
    params:
        settings=search_settings,
        clusters=lambda wildcards: BENCHMARK.searches[wildcards.search].clusters,
        code=code_digest("neuspring.twin.search"),
    shell:
        gpu_job(
            "search --observations {input.observations:q} --settings {params.settings:q}"
            " --clusters {params.clusters} --seed {wildcards.seed} --threads {threads} --output {output:q}"
        )


rule fit:
    input:
        observations=rules.observe.output,
        search=search_record,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/fit.json",
    log:
        f"{RESULTS}/logs/fit/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit/{{scenario}}/{{method}}/{{seed}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=fit_work,
        gpu=GPU,
        mem_mb=memory("fit", 8000),
        runtime=minutes("fit", 480, fit_work),
    params:
        settings=fit_settings,
        kind=lambda wildcards: BENCHMARK.fits[wildcards.method].fit,
        code=code_digest("neuspring.twin.fit"),
    shell:
        gpu_job(
            "fit --observations {input.observations:q} --search {input.search:q} --settings {params.settings:q}"
            " --kind {params.kind} --threads {threads} --output {output:q}"
        )


rule rollout:
    input:
        observations=rules.observe.output,
        twin=rollout_twins,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/rollout.json",
    log:
        f"{RESULTS}/logs/rollout/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/rollout/{{scenario}}/{{method}}/{{seed}}.tsv"
    wildcard_constraints:
        method=methods_with_search(),
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=GPU,
        mem_mb=memory("rollout", 4000),
        runtime=minutes("rollout", 60, frame_work),
    params:
        carry=carry_option,
        code=code_digest(
            "neuspring.twin.rollout", "neuspring.twin.motion", "neuspring.twin.carry", stage="stages.stages.rollout"
        ),
    shell:
        gpu_job(
            "rollout --observations {input.observations:q} --twin {input.twin:q} {params.carry}"
            " --threads {threads} --output {output:q}"
        )


rule transfer:
    input:
        targets=transfer_targets,
        twin=learned_record,
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/transfer.json",
    log:
        f"{RESULTS}/logs/transfer/{{scenario}}/{{method}}/{{seed}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/transfer/{{scenario}}/{{method}}/{{seed}}.tsv"
    priority: GPU_FIRST
    retries: 2
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        work=frame_work,
        gpu=GPU,
        mem_mb=memory("transfer", 4000),
        runtime=minutes("transfer", 60, frame_work),
    params:
        settings=section("simulation"),
        code=transfer_digest,
    shell:
        gpu_job(
            "transfer --targets {input.targets:q} --twin {input.twin:q} --settings {params.settings:q}"
            " --method {wildcards.method} --seed {wildcards.seed} --threads {threads}"
            " --output {output:q}"
        )
