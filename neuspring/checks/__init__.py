"""What is looked for in data, before any cost: one file per kind of subject, with its measurements and its checks.

To add a check: a function that measures, and an entry of `CHECKS` in the file of its subject. A package adds one, a `Check` of one
of our subjects, by an entry point of the group `neuspring.checks`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from neuspring.core import checks
from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.registry import Registry, modules

CHECKS: Registry[Check | tuple[Check, ...]] = Registry("checks", modules(__name__, "CHECKS"), (Check, tuple))
"""Our files, each with the checks of its subjects, and the checks of packages."""


def examine(subject: Any, own: Sequence[Check] = ()) -> list[Finding]:
    """All findings about a subject: by `own` checks, those of the file here that declares its kind, and those of packages."""
    return checks.examine(subject, [*own, *_for(type(subject).__module__)])


def _for(module: str) -> Iterator[Check]:
    for name in CHECKS:
        if not (declared := CHECKS.module_of(name)).startswith(f"{__name__}.") or declared == module:
            member = CHECKS[name]
            yield from (member,) if isinstance(member, Check) else member
