"""The command doctor."""

from __future__ import annotations

from neuspring.cli.options import Settings, read_settings


def doctor(settings: Settings = "{}") -> int:
    """Say what this machine can do, and what is missing; 1 where something that is configured cannot work."""
    from neuspring.extensions.doctor.machine import examine, text

    findings = examine(read_settings(settings))
    print(text(findings))
    return int(any(finding.state == "broken" for finding in findings))
