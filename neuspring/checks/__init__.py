"""Checks of data, before any cost. `table` lists all of them with their limits; the other files measure.

To add a check: a function that measures, and an entry of `table.checks`. A package adds `Check`s of one of our kinds of subject
by an entry point of the group `neuspring.checks`.
"""

from __future__ import annotations

from typing import Any

from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.registry import Registry

CHECKS: Registry[Check | tuple[Check, ...]] = Registry("checks", {"core": "neuspring.checks.table:checks"}, (Check, tuple))
"""The table of the core, and the checks of packages."""


def examine(of: str, where: object, *subject: Any, streams: frozenset[str] | None = None) -> list[Finding]:
    """All findings about a `subject` of the kind `of`, found at the file, camera or other place `where`.

    `streams`: those of the capture, where checks that need others are left out.
    """
    listed = [one for member in CHECKS.values() for one in ((member,) if isinstance(member, Check) else member)]
    fitting = [check for check in listed if check.of == of and (streams is None or streams.issuperset(check.needs))]
    return [found for check in fitting for found in check.findings(where, *subject)]
