"""Checks as data: a measurement, its accepted range, the effect on results outside of it, and the next step.

A measurement is a function of a subject, for example the masks of a camera, 3D points, or the content of a file. Each kind of
subject has a name.
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
    """Name of the finding; the same for every occurrence."""
    of: str
    """The kind of subject."""
    measure: Callable[..., float | Words | Iterable[Words] | None]
    """Subject -> the value, or a mapping of words with the value under `value`, or several of these; None: no finding.

    The words `level`, `where` and `frames` override those of the finding; `detail` is printed after the value."""
    limit: tuple[float, float] | None
    """Lowest and highest accepted value; None: every measurement is reported."""
    level: Level
    sentence: str
    """What is measured: a format string over the words, `low` and `high` of the limit, and the subject as {0}, {1}, ..."""
    remedy: str = ""
    """The next step; also a format string."""
    title: str | None = None
    """Start of the message before the sentence, a format string: the key of a file; None: the name."""
    unit: str = ""
    """Unit of the value; "%": the value is a fraction."""
    effect: str = ""
    """Effect on results outside of the limit. If it is given, the message states value and limit after the sentence."""
    needs: tuple[str, ...] = ()
    """Streams of a capture (color, depth, mask) that the check requires; without them it is skipped."""

    def findings(self, where: object, *subject: Any) -> Iterator[Finding]:
        """Yield the findings about a subject; `where` is its file or camera."""
        low, high = self.limit or (-inf, inf)
        for measured in _several(self.measure(*subject)):
            value: Any = measured.get("value")
            if self.limit is not None and value is not None and low <= value <= high:
                continue
            words = {"low": low, "high": high, **measured}
            remedy = self.remedy.format(*subject, **words)
            text = self.sentence.format(*subject, **words)
            if self.effect:
                detail = f" ({measured['detail']})" if measured.get("detail") else ""
                text += f": {self.shown(value)}{detail}" if value is not None else detail
                text += (f", {self.expected()} expected" if self.limit else "") + f"; {self.effect}."
            yield Finding(
                name=self.name,
                level=measured.get("level", self.level),
                where=str(measured.get("where", where)),
                text=f"{text} {remedy}".rstrip(),
                remedy=remedy,
                title=None if self.title is None else self.title.format(*subject, **words),
                value=value.item() if hasattr(value, "item") else value,  # json cannot write NumPy scalars
                limit=None if self.limit is None else (_bound(low), _bound(high)),
                frames=tuple(int(frame) for frame in measured.get("frames", ())),
            )

    def shown(self, value: Any) -> str:
        """The value with its unit, as text."""
        if isinstance(value, str):
            return value
        return f"{self._number(value)} {self.unit}".rstrip()

    def _number(self, value: float) -> str:
        return f"{100 * value if self.unit == '%' else value:.4g}"

    def expected(self) -> str:
        """The accepted range, in words; empty without a limit."""
        if self.limit is None:
            return ""
        low, high = self.limit
        if isfinite(low) and isfinite(high) and low not in (0, -high):
            return f"{self._number(low)} to {self.shown(high)}"
        if high == 0:
            return "none"
        return f"at least {self.shown(low)}" if not isfinite(high) else f"at most {self.shown(high)}"


def _bound(limit: float) -> float | None:
    return float(limit) if isfinite(limit) else None


def _several(measured: float | Words | Iterable[Words] | None) -> Iterable[Words]:
    if measured is None:
        return ()
    if isinstance(measured, Mapping):
        return (measured,)
    return measured if isinstance(measured, Iterable) else ({"value": measured},)
