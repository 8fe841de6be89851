"""A check as data: what is measured of a subject, the limit, and what is said where the measurement departs from it.

A subject has a kind, a word, and is what `examine` is given of it: the masks of a camera, points in space, the content of a file. A
measurement is a function of that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

from neuspring.core.findings import Finding, Level

Words = Mapping[str, Any]


@dataclass(frozen=True)
class Check:
    """One check of one kind of subject."""

    name: str
    """The finding's; the same for every occurrence."""
    of: str
    """The kind of subject."""
    measure: Callable[..., float | Words | Iterable[Words] | None]
    """Subject -> the value, or what fills the sentence with the value under `value`, or several of these; None: nothing to say.

    Under `level`, `where` and `frames` a measurement may bring those of the finding."""
    limit: tuple[float, float] | None
    """Lowest and highest value that is fine; None: whatever is measured is said."""
    level: Level
    sentence: str
    """A format string over the words, `low` and `high` of the limit, and the subject as {0}, {1}, ...: the value and the rule it
    departs from."""
    remedy: str = ""
    """The next move, a format string too."""
    title: str | None = None
    """Beginning of messages before the sentence, a format string: the key of a file; None: the name."""

    def findings(self, where: object, *subject: Any) -> Iterator[Finding]:
        """Every finding about a subject, at the file, camera or other place `where`."""
        low, high = self.limit or (-inf, inf)
        for measured in _several(self.measure(*subject)):
            value: Any = measured.get("value")
            if self.limit is not None and value is not None and low <= value <= high:
                continue
            words = {"low": low, "high": high, **measured}
            remedy = self.remedy.format(*subject, **words)
            yield Finding(
                name=self.name,
                level=measured.get("level", self.level),
                where=str(measured.get("where", where)),
                text=f"{self.sentence.format(*subject, **words)} {remedy}".rstrip(),
                remedy=remedy,
                title=None if self.title is None else self.title.format(*subject, **words),
                value=value.item() if hasattr(value, "item") else value,  # a number of NumPy is none of JSON
                limit=None if self.limit is None else (_bound(low), _bound(high)),
                frames=tuple(int(frame) for frame in measured.get("frames", ())),
            )


def _bound(limit: float) -> float | None:
    return float(limit) if isfinite(limit) else None


def _several(measured: float | Words | Iterable[Words] | None) -> Iterable[Words]:
    if measured is None:
        return ()
    if isinstance(measured, Mapping):
        return (measured,)
    return measured if isinstance(measured, Iterable) else ({"value": measured},)
