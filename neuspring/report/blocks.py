"""The parts of a page as values: as HTML by a template, which escapes every text; paragraphs, lists and tables also as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from neuspring.core.table import Chip, Table, Tone

PAGE_TEMPLATES = Path(__file__).parent / "templates"
SYMBOLS: dict[Tone, str] = {"good": "✓", "bad": "✗", "warn": "!", "mute": "○", "": ""}


@dataclass(frozen=True, kw_only=True)
class Text:
    """A paragraph; `tone` makes it a note, `label` stands in front of it."""

    text: str
    tone: Tone = ""
    label: str = ""


@dataclass(frozen=True, kw_only=True)
class Items:
    """A list below a title."""

    items: Sequence[str]
    title: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer of one study."""

    title: str
    answer: str
    tone: Tone
    chips: Sequence[Chip]
    small: Sequence[str] = ()
    target: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture or a film; without `data`, a link to the file and why it is not shown."""

    caption: str
    alt: str = ""
    """Empty for a film, which has no such text."""
    film: bool = False
    data: str = ""
    """Its source: a data URI, or the path of a file on a page that is not self-contained."""
    link: str = ""
    reason: str = ""
    wide: bool = False
    """Keeps a readable width, and scrolls on small screens."""
    paper: bool = False
    """Drawn for a white page."""
    size: tuple[int, int] = (0, 0)
    panel: int | None = None
    """The panel that is seen of a film of three side by side; None: all of it."""
    head: float = 0.0
    """Height of what stands above the panels, over the width of the film."""
    same: bool = False
    """Another panel of the first film beside it, which the page's script adds, so that no film is there twice."""
    frames: Sequence[tuple[str, str]] = ()
    """Text and address of frames in the playground."""


@dataclass(frozen=True, kw_only=True)
class Legend:
    """Samples of lines: name, color, dash pattern (SVG)."""

    entries: Sequence[tuple[str, str, str]]


@dataclass(frozen=True, kw_only=True)
class Prose:
    """HTML that was rendered from Markdown."""

    html: Markup


@dataclass(frozen=True, kw_only=True)
class Code:
    """Preformatted text."""

    text: str
    whole: bool = False
    """A click selects all of it, to be copied."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Blocks side by side, as many as fit."""

    blocks: Sequence[Block]
    least: int = 17
    """Smallest width of a column, rem."""
    films: bool = False
    """The videos among them play in step, with one control."""
    fit: bool = False
    """A few blocks fill the width."""
    training: float = 0.0
    """Share of the films that is training; 0: the control does not tell."""


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Blocks that are shown on a click."""

    summary: str
    blocks: Sequence[Block]
    open: bool = False
    key: str = ""


Block = Table | Text | Items | Answer | Picture | Legend | Prose | Code | Grid | Fold


@dataclass(frozen=True, kw_only=True)
class PageSection:
    """A part of the page with an entry in its table of contents."""

    key: str
    title: str
    blocks: Sequence[Block]
    about: str = ""
    folded: bool = False
    """Shown on a click on its title."""


def markdown(blocks: Sequence[Block], level: str = "##") -> str:
    """Tables, paragraphs and lists as Markdown; what is folded on a page is not folded here."""
    parts = []
    for block in blocks:
        if isinstance(block, Table):
            parts += [f"{level} {block.caption}"] if block.caption else []
            parts += [block.note] if block.note else []
            parts.append("\n".join(block.markdown()))
        elif isinstance(block, Text):
            text = f"**{block.label}:** {block.text}" if block.label else block.text
            parts.append(f"**{text}**" if block.tone == "warn" else text)
        elif isinstance(block, Items):
            parts += [f"{block.title}:"] if block.title else []
            parts.append("\n".join(f"- {item}" for item in block.items))
        elif isinstance(block, Code):
            parts.append(f"```sh\n{block.text}\n```")
        elif isinstance(block, Fold):
            parts.append(markdown(block.blocks, level).rstrip("\n"))
        else:
            raise TypeError(f"{type(block).__name__} has no Markdown")
    return "\n\n".join(parts) + "\n" if parts else ""


def html_page(title: str, subtitle: str, sections: Sequence[PageSection], *, written: str = "", embedded: bool = True) -> str:
    """The page as text. `embedded`: nothing but what it contains may be loaded; otherwise files beside it are shown too."""
    loader = jinja2.FileSystemLoader(PAGE_TEMPLATES)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["coded"] = lambda text: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
    return environment.get_template("page.html.j2").render(
        title=title,
        subtitle=subtitle,
        written=written,
        sections=sections,
        embedded=embedded,
        symbols=SYMBOLS,
        style=Markup((PAGE_TEMPLATES / "style.css").read_text(encoding="utf-8")),
        script=Markup((PAGE_TEMPLATES / "page.js").read_text(encoding="utf-8")),
    )
