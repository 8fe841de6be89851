# The benchmark: captures -> observations -> search -> fit -> rollout -> pictures -> scores -> tables, every run in MLflow.
from snakemake.utils import min_version

min_version("9.20")


configfile: f"{workflow.basedir}/config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/hooks.smk"
include: "workflow/rules/stages.smk"
include: "workflow/rules/results.smk"
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
        **SHOWN,
        page=rules.report.output,
        logged=GRAPH.logged_runs(),


# A job that fails is tried twice again, with more memory. On a cluster it is the main process that tries again: inside a submitted
# job rules' own retries would multiply.
for each in workflow.rules:
    each.restart_times = 0 if workflow.remote_exec else 2


onstart:
    begin()


onsuccess:
    finish()


onerror:
    give_up()
