"""Commands `fetch` and `verify-released`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import Device, Positional, arg


def fetch(
    source: Positional[Literal["phystwin"]],
    scenarios: Annotated[Positional[tuple[str, ...]], arg(help="all 22 by default")] = (),
    *,
    data_root: Annotated[Path, arg(help="folder to write to; data_root of the configuration")],
    parts: Annotated[
        tuple[str, ...], arg(help="data, results, appearance, images, other; all: these five; extra: more clothes")
    ] = ("data", "results"),
    revision: Annotated[str, arg(help="branch, tag or commit of the data set")] = "main",
    dry_run: Annotated[bool, arg(help="say what would be fetched and the space it takes")] = False,
) -> int:
    """Released archives -> the folders that the readers expect; exit status 2 if a fetched file is damaged."""
    from neuspring.extensions.released import fetch
    from neuspring.intake.check import render

    findings = fetch.fetch(data_root, scenarios, parts, revision=revision, dry_run=dry_run)
    if dry_run:
        return 0
    print(render(findings))
    return 2 if any(finding.level == "error" for finding in findings) else 0


def verify_released(
    data_root: Annotated[Positional[Path], arg(help="folder that holds data, experiments and the other released folders")],
    output: Annotated[Path, arg(help="folder to write to")],
    scenarios: Annotated[tuple[str, ...], arg(help="all that are there by default")] = (),
    checks: Annotated[
        tuple[int, ...],
        arg(help="1 sizes and first frame, 2 springs, 3 scores, 4 deprojection, 5 pictures, 6 replay; all by default"),
    ] = (),
    device: Device = "auto",
) -> int:
    """PhysTwin's released results, checked against ours."""
    from neuspring.extensions.released import run

    chosen = checks or tuple(run.RELEASED_CHECKS)
    report = run.verify_released(data_root, output, scenarios=scenarios, checks=chosen, device=device)
    print(report.text, end="")
    return report.status
