"""The parts of a page. Blocks hold data and text. The template turns them into HTML and escapes every text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from markupsafe import Markup

Tone = Literal["", "good", "bad", "warn", "mute"]
SYMBOLS: dict[Tone, str] = {"good": "✓", "bad": "✗", "warn": "!", "mute": "○", "": ""}


@dataclass(frozen=True, kw_only=True)
class Chip:
    """A word on a colored ground, with a symbol, so that nothing is said by color alone."""

    text: str
    tone: Tone = ""
    symbol: str = ""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell: a main text, smaller lines and chips below it."""

    text: str = ""
    small: Sequence[str] = ()
    chips: Sequence[Chip] = ()
    best: bool = False
    mark: str = ""
    """Words for `best`, for screen readers."""
    tone: Tone = ""
    value: float | str | None = None
    """Key by which the column is sorted; None: the text."""
    wrap: bool = False
    """May take several lines."""
    link: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table; the first `stub` cells of every row are its headings."""

    kind: ClassVar[str] = "table"
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    """A line above the header: text and number of columns."""
    stub: int = 1
    sortable: bool = False
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Text:
    """A paragraph; `tone` makes it a note."""

    kind: ClassVar[str] = "text"
    text: str
    tone: Tone = ""


@dataclass(frozen=True, kw_only=True)
class Items:
    """A list."""

    kind: ClassVar[str] = "items"
    items: Sequence[str | Link]


@dataclass(frozen=True, kw_only=True)
class Link:
    """A file beside the report; `note` follows it."""

    text: str
    target: str
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Large numbers with a label each."""

    kind: ClassVar[str] = "facts"
    facts: Sequence[tuple[str, str, str]]
    """Number, label, small print."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The answer of one study."""

    kind: ClassVar[str] = "verdict"
    title: str
    answer: str
    tone: Tone
    chips: Sequence[Chip]
    small: Sequence[str] = ()
    target: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture; without `data`, a link to the file and why it is not shown."""

    kind: ClassVar[str] = "picture"
    caption: str
    alt: str
    data: str = ""
    """Its source: a data URI, or the path of a file on a page that is not self-contained."""
    link: str = ""
    reason: str = ""
    wide: bool = False
    """Keeps a readable width, and scrolls on small screens."""
    paper: bool = False
    """Drawn for a white page."""
    size: tuple[int, int] = (0, 0)
    frames: Sequence[tuple[str, str]] = ()
    """Text and address of frames in the playground."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """A video, as `Picture`."""

    kind: ClassVar[str] = "video"
    caption: str
    data: str = ""
    link: str = ""
    reason: str = ""
    wide: bool = False


@dataclass(frozen=True, kw_only=True)
class Legend:
    """Samples of lines: name, color, dash pattern (SVG)."""

    kind: ClassVar[str] = "legend"
    entries: Sequence[tuple[str, str, str]]


@dataclass(frozen=True, kw_only=True)
class Prose:
    """HTML that was rendered from Markdown."""

    kind: ClassVar[str] = "prose"
    html: Markup


@dataclass(frozen=True, kw_only=True)
class Code:
    """Preformatted text."""

    kind: ClassVar[str] = "code"
    text: str
    whole: bool = False
    """A click selects all of it, to be copied."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Blocks side by side, as many as fit."""

    kind: ClassVar[str] = "grid"
    blocks: Sequence[Block]
    least: int = 17
    """Smallest width of a column, rem."""


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Blocks that are shown on a click."""

    kind: ClassVar[str] = "fold"
    summary: str
    blocks: Sequence[Block]
    open: bool = False
    key: str = ""


Block = Table | Text | Items | Facts | Verdict | Picture | Video | Legend | Prose | Code | Grid | Fold


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the page with an entry in its table of contents."""

    key: str
    title: str
    blocks: Sequence[Block]
    about: str = field(default="")
