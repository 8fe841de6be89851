# The benchmark: captures -> observations -> search -> fit -> rollout -> pictures -> scores -> tables, every run in MLflow.
from snakemake.utils import min_version

min_version("9.20")


configfile: "config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/helpers/perceive.smk"
include: "workflow/rules/helpers/images.smk"
include: "workflow/rules/helpers/twin.smk"
include: "workflow/rules/helpers/baselines.smk"
include: "workflow/rules/helpers/sweep.smk"
include: "workflow/rules/helpers/tables.smk"
include: "workflow/rules/helpers/hooks.smk"
include: "workflow/rules/perceive.smk"
include: "workflow/rules/observe.smk"
include: "workflow/rules/twin.smk"
include: "workflow/rules/images.smk"
include: "workflow/rules/baselines.smk"
include: "workflow/rules/score.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/tracking.smk"
include: "workflow/rules/sweep.smk"


# On a cluster these run where Snakemake runs: seconds of work each.
localrules:
    all,
    track_init,
    tables,
    study,
    report,
    perception_table,
    sweep,


rule all:
    default_target: True
    input:
        tables=TABLES,
        studies=[study_table(name) for name in CONFIG.studies],
        report=REPORT,
        perception=perception_tables(),
        tracked=tracked_runs(),


# The last: a study is a target by its name, which must not be another's.
include: "workflow/rules/studies.smk"


# It is the main process that tries a job again, with more memory: inside a submitted job rules' own retries would multiply.
if workflow.remote_exec:
    for submitted in workflow.rules:
        submitted.restart_times = 0


onstart:
    begin()


onsuccess:
    report_end(failed=False)


onerror:
    report_end(failed=True)
