"""Run one job of any rule. Snakemake provides `snakemake` with the configuration of the plan."""

from pathlib import Path

from neuspring.cli.main import COMMANDS
from neuspring.experiments.job import run

try:
    from neuspring.extensions.tuning import jobs as SWEEPS
except ModuleNotFoundError:
    SWEEPS = None

run(
    snakemake.config,  # noqa: F821 - Snakemake's
    Path(__file__).absolute().parents[2],
    COMMANDS,
    SWEEPS,
    snakemake.rule,  # noqa: F821
    snakemake.wildcards.job,  # noqa: F821
    snakemake.wildcards.digest,  # noqa: F821
    threads=snakemake.threads,  # noqa: F821
    gpus=snakemake.resources.get("gpu", 0),  # noqa: F821
)
