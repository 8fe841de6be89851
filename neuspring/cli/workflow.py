"""The command demo."""

from __future__ import annotations

import os
from typing import Annotated

from neuspring.cli.options import arg


def demo(
    cores: Annotated[int | None, arg(help="default: all")] = None,
    dry_run: Annotated[bool, arg(help="list the jobs without running them")] = False,
) -> None:
    """Make twins of three synthetic scenes, with scores, videos and a report in ./results (config/data/demo.yaml)."""
    from neuspring.core.extras import needed
    from neuspring.experiments.local import workflow_command

    needed("newton"), needed("av")
    command = workflow_command("demo", *(["--dry-run"] if dry_run else []), cores=cores)
    # Snakemake replaces this process, so that only Snakemake receives Ctrl-C.
    os.execv(command[0], command)
