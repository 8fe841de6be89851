"""Checks of data and of perception's results. `table` lists all checks with their limits; the other modules measure.

To add a check, write a function that measures, and add an entry to `table.checks`. A package adds a `Check`, or several, of the
existing kinds of subject by an entry point of the group `neuspring.checks`.
"""

from __future__ import annotations

from typing import Any

from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.registry import Registry

CHECKS: Registry[Check | tuple[Check, ...]] = Registry("checks", {"core": "neuspring.checks.table:checks"}, (Check, tuple))
"""The checks of the core and of packages."""


def examine(of: str, where: object, *subject: Any, streams: frozenset[str] | None = None) -> list[Finding]:
    """All findings about a `subject` of the kind `of`; `where` is its file, camera or other location.

    `streams` are the streams of the capture: checks that need another stream are skipped. None: no check is skipped.
    """
    listed = [check for member in CHECKS.values() for check in ((member,) if isinstance(member, Check) else member)]
    fitting = [check for check in listed if check.of == of and (streams is None or streams.issuperset(check.needs))]
    return [finding for check in fitting for finding in check.findings(where, *subject)]
