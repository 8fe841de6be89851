# The workflow: captures -> observations -> search -> fit -> predictions, images and scores -> tables; all runs in MLflow.
from snakemake.utils import min_version

min_version("9.20")


configfile: f"{workflow.basedir}/config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/jobs.smk"


# On a cluster these rules run on the machine of Snakemake, because each takes only seconds.
localrules:
    all,
    sweep,
    tables,
    study,
    page,
    report,
    perception_table,
    sweep_report,


rule all:
    default_target: True
    input:
        target(
            lambda graph, tasks: [
                graph.unit("page", "all"),
                *tasks.shown(),
                *graph.runs(),
            ]
        ),


rule report:
    input:
        target(lambda graph, tasks: [graph.unit("page", "all")]),


rule sweep:
    input:
        target(lambda graph, tasks: [graph.unit("sweep_report", "all")]),


# The name of each study is a target, so it must differ from all other targets.
for STUDY in BENCHMARK.studies:
    if STUDY in {other.name for other in workflow.rules}:
        reason = "another target has this name; rename the study."
        raise WorkflowError(f"{CONFIG.study_table}, study {STUDY}: {reason}")

    rule:
        name:
            STUDY
        input:
            target(
                lambda graph, tasks, study=STUDY: [
                    graph.unit("study", study),
                    *graph.runs(graph.benchmark.methods_of(study)),
                ]
            ),


onstart:
    or_workflow_error(
        messages.begin,
        jobs()[0],
        len(jobs()[0].todo(RUN.get("targets", []))),
        local=not workflow.non_local_exec,
        cores=workflow.resource_settings.cores,
        cluster=CLUSTER,
    )
    tell_plan()


onsuccess:
    messages.finished(jobs()[0], BEGUN)


onerror:
    messages.failed(*jobs(), BEGUN)
