"""Checks of data, before any cost: one file per area, with its measurements and its checks.

To add a check: a function that measures, and an entry of `checks` in a file here. A package adds one, a `Check` of one of our kinds
of subject, by an entry point of the group `neuspring.checks`.
"""

from __future__ import annotations

from typing import Any

from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.registry import Registry, modules

CHECKS: Registry[Check | tuple[Check, ...]] = Registry("checks", modules(__name__, "checks"), (Check, tuple))
"""Our files, each with its checks, and the checks of packages."""


def examine(of: str, where: object, *subject: Any) -> list[Finding]:
    """All findings about a `subject` of the kind `of`, found at the file, camera or other place `where`."""
    listed = [one for member in CHECKS.values() for one in ((member,) if isinstance(member, Check) else member)]
    return [found for check in listed if check.of == of for found in check.findings(where, *subject)]
