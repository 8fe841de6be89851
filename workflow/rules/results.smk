# Tables, report, and MLflow, which is an index of the records: its rules never fail a run, and no number depends on them.
# The rule tables computes every number, once; study and report read its file.
from neuspring.registry import modules

PERCEIVED, TABULATED, STUDIED, REPORTED, TRACKED = (
    stamped_job(
        "perception_table",
        CONFIG.tables,
        PERCEPTION_TABLE,
        lambda wildcards: GRAPH.perception(),
        "neuspring.report.perception",
    ),
    stamped_job(
        "tables",
        CONFIG.tables,
        TABLES,
        lambda wildcards: GRAPH.tables(),
        "neuspring.report.summary",
        "neuspring.report.gallery",
    ),
    stamped_job(
        "study",
        f"{CONFIG.tables}/{{study}}",
        f"{GRAPH.folder}/studies/{{study}}.md",
        lambda wildcards: [
            *GRAPH.study(wildcards.study),
            json.dumps(settings.plain(BENCHMARK.studies[wildcards.study])),
        ],
        "neuspring.report.study",
        "neuspring.report.clips",
    ),
    stamped_job(
        "report",
        CONFIG.tables,
        REPORT,
        lambda wildcards: [*GRAPH.report(), *GRAPH.report_stamp()],
        "neuspring.report.page",
        *(
            place.partition(":")[0]
            for place in modules("neuspring.report.sections").values()
        ),
    ),
    stamped_job(
        "track_init",
        "mlflow",
        f"{RESULTS}/mlflow.json",
        lambda wildcards: [section("tracking")],
    ),
)


rule perception_table:
    input:
        [
            f"{RESULTS}/{name}/perception/judged.json"
            for name in GRAPH.judged(CONFIG.scenarios)
        ],
        PERCEIVED[1],
    output:
        PERCEPTION_TABLE,
    log:
        PERCEIVED[0],
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("perception_table"),
        runtime=NEEDS.minutes("perception_table"),
    params:
        arguments=GRAPH.perception(),
        stamp=PERCEIVED[2],
    shell:
        common_job("perception-table {params.arguments:q} --output {output:q}")


rule tables:
    input:
        runs=GRAPH.runs(),
        transfers=GRAPH.transfers(),
        compared=TABULATED[1],
    output:
        TABLES,
        numbers=f"{GRAPH.folder}/numbers.json",
    log:
        TABULATED[0],
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("tables"),
        runtime=NEEDS.minutes("tables"),
    params:
        arguments=GRAPH.tables(),
        stamp=TABULATED[2],
    shell:
        common_job("tables {params.arguments:q}")


rule study:
    input:
        STUDIED[1],
        numbers=rules.tables.output.numbers,
    output:
        f"{GRAPH.folder}/studies/{{study}}.md",
    log:
        STUDIED[0],
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("study"),
        runtime=NEEDS.minutes("study"),
    params:
        arguments=lambda wildcards: GRAPH.study(wildcards.study),
        stamp=STUDIED[2],
    shell:
        common_job("study {params.arguments:q}")


# What the report shows, beside the runs.
SHOWN = {
    "tables": TABLES,
    "studies": expand(rules.study.output, study=CONFIG.studies),
    "perception": [PERCEPTION_TABLE] if GRAPH.judged(CONFIG.scenarios) else [],
}


rule report:
    input:
        **SHOWN,
        compared=REPORTED[1],
    output:
        REPORT,
    log:
        REPORTED[0],
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("report"),
        runtime=NEEDS.minutes("report"),
    params:
        arguments=GRAPH.report(),
        stamp=REPORTED[2],
    shell:
        common_job("report {params.arguments:q}")


rule track_init:
    input:
        compared=TRACKED[1],
    output:
        f"{RESULTS}/mlflow.json",
    log:
        TRACKED[0],
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("track_init"),
        runtime=NEEDS.minutes("track_init"),
    params:
        settings=section("tracking"),
        stamp=TRACKED[2],
        results=lambda wildcards, output: str(Path(output[0]).parent),
    shell:
        common_job(
            "track-init --results {params.results:q} --settings {params.settings:q} --output {output:q}"
        )


rule log_run:
    input:
        store=rules.track_init.output,
        record=f"{RESULTS}/{STAGES['score'].output}",
    output:
        f"{RESULTS}/{{scenario}}/{{method}}/{{seed}}/mlflow.txt",
    log:
        log_of("log_run", "{scenario}/{method}/{seed}"),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=NEEDS.memory("log_run"),
        runtime=NEEDS.minutes("log_run"),
    params:
        settings=section("tracking"),
        results=lambda wildcards, input: str(Path(input.store[0]).parent),
    shell:
        wrapped(
            "--scenario {wildcards.scenario}",
            "log --record {input.record:q} --results {params.results:q} --settings {params.settings:q} --output {output:q}",
        )


# A study of the paper is a target by its name, which must not be another's.
for study_name in BENCHMARK.studies:
    if study_name in {other.name for other in workflow.rules} | {"all", "sweep"}:
        raise WorkflowError(
            f"{CONFIG.study_table}, study {study_name}: this is the name of another target; rename the study."
        )

    rule:
        name:
            study_name
        input:
            f"{GRAPH.folder}/studies/{study_name}.md",
            GRAPH.logged_runs(BENCHMARK.methods_of(study_name)),
