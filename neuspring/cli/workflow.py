"""The command demo."""

from __future__ import annotations

import os
from typing import Annotated

from neuspring.cli.options import arg


def demo(
    cores: Annotated[int | None, arg(help="all by default")] = None,
    dry_run: Annotated[bool, arg(help="name the jobs, and run none")] = False,
) -> None:
    """Three synthetic scenes, from raw video to a table and films in ./results, as config/data/demo.yaml says."""
    from neuspring.core.extras import needed
    from neuspring.experiments.local import workflow_command

    needed("newton"), needed("av")
    command = workflow_command("demo", *(["--dry-run"] if dry_run else []), cores=cores)
    # Snakemake takes this process's place, so that Ctrl-C reaches it alone.
    os.execv(command[0], command)
