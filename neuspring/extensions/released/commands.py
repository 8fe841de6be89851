"""The commands `fetch` and `verify-released`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.data import check_data
from neuspring.cli.options import Positional, arg


def fetch(
    source: Positional[Literal["phystwin"]],
    scenarios: Annotated[Positional[tuple[str, ...]], arg(help="default: all 22")] = (),
    *,
    data_root: Annotated[Path, arg(help="folder to write to; data_root of the configuration")],
    parts: Annotated[
        tuple[Literal["data", "results", "images"], ...],
        arg(help="data: processed cases; results: predictions, checkpoints, parameters; images: color, depth, masks"),
    ] = ("data", "results"),
    revision: Annotated[str, arg(help="branch, tag or commit of the data set")] = "main",
    dry_run: Annotated[bool, arg(help="only print the sizes")] = False,
) -> int:
    """Fetch PhysTwin's released files into the folders that readers expect; exit status 2 if a fetched file is damaged."""
    from neuspring.extensions.released import fetch

    fetch.fetch(data_root, scenarios, parts, revision, dry_run=dry_run)
    return 0 if dry_run or "data" not in parts else check_data(data_root)


def verify_released(
    data_root: Annotated[Positional[Path], arg(help="folder that contains data, experiments and experiments_optimization")],
    output: Annotated[Path, arg(help="folder to write to")],
    scenarios: Annotated[tuple[str, ...], arg(help="default: all in this folder")] = (),
) -> int:
    """Compare PhysTwin's released results with this code; exit status 1 if one differs, 2 if no comparison is possible."""
    from neuspring.extensions.released import verify

    table = verify.verify_released(data_root, output, scenarios)
    print(table.to_string(index=False, na_rep="-"))
    outcomes = set(table["outcome"])
    return 1 if "failed" in outcomes else 0 if "passed" in outcomes else 2
