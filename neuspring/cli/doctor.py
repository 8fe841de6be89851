"""The command doctor."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from neuspring.cli import options as shared


def doctor_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring doctor`."""
    shared.add_settings(parser)


def doctor(a: Namespace) -> int:
    """`neuspring doctor`: 1 where something that is configured cannot work."""
    from neuspring.experiments.doctor import examine, text

    findings = examine(shared.read_settings(a.settings))
    print(text(findings))
    return int(any(finding.state == "broken" for finding in findings))
