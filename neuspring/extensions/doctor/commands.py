"""The command `doctor`."""

from __future__ import annotations

from neuspring.cli.options import Settings, read_settings


def doctor(settings: Settings = "{}") -> int:
    """Check this machine and list missing items; exit status 1 if the configuration needs one of them."""
    from neuspring.extensions.doctor.machine import examine, text

    findings = examine(read_settings(settings))
    print(text(findings))
    return int(any(finding.state == "broken" for finding in findings))
