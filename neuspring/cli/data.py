"""Commands on data: fetch, check-data, verify-released."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.cli import options as shared

if TYPE_CHECKING:
    from neuspring.core.findings import Finding


def fetch_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring fetch`."""
    parser.add_argument("source", choices=["phystwin"])
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="all 22 by default")
    parser.add_argument("--data-root", type=Path, required=True, help="folder to write to; data_root of the configuration")
    parts = "data, results, appearance, images, other; all: these five; extra: more clothes"
    parser.add_argument("--parts", nargs="+", default=["data", "results"], help=f"{parts} (default: data results)")
    parser.add_argument("--revision", default="main", help="branch, tag or commit of the data set")
    parser.add_argument("--dry-run", action="store_true", help="say what would be fetched and the space it takes")


def fetch(a: Namespace) -> int:
    """`neuspring fetch`: exit status 2 if a fetched file is damaged."""
    from neuspring.data import fetch
    from neuspring.scores.released.check_data import check

    findings = fetch.fetch(a.data_root, a.scenarios, a.parts, revision=a.revision, dry_run=a.dry_run, check=check)
    return 0 if a.dry_run else _tell(findings)


def check_data_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring check-data`."""
    parser.add_argument("folder", type=Path)


def check_data(a: Namespace) -> int:
    """`neuspring check-data`: 2 where the data cannot be used."""
    from neuspring.scores.released.check_data import check

    return _tell(check(a.folder))


def _tell(findings: list[Finding]) -> int:
    """Print findings; returns 2 where the data cannot be used."""
    from neuspring.data.check import render

    print(render(findings))
    return 2 if any(finding.level == "error" for finding in findings) else 0


def verify_released_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring verify-released`."""
    parser.add_argument("data_root", type=Path, help="folder that holds data, experiments and the other released folders")
    parser.add_argument("--scenarios", nargs="+", default=(), help="all that are there by default")
    checks = "1 sizes and first frame, 2 springs, 3 scores, 4 deprojection, 5 pictures, 6 replay; all by default"
    parser.add_argument("--checks", nargs="+", type=int, help=checks)
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser, "folder to write to")


def verify_released(a: Namespace) -> int:
    """`neuspring verify-released`."""
    from neuspring.scores.released import run

    report = run.verify_released(
        a.data_root,
        a.output,
        scenarios=a.scenarios,
        checks=a.checks or tuple(run.CHECKS),
        device=a.device,
        lpips=shared.read_settings(a.settings).images.lpips,
    )
    print(report.text, end="")
    return report.status
