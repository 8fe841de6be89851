"""The parts of a page as values. A template turns them into HTML and escapes every text; most parts also exist as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
from markupsafe import Markup

from neuspring.core.table import Table, coded, lay_out

PAGE_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True, kw_only=True)
class Text:
    """A paragraph. A `tone` makes it a colored note; the tone "lead" makes it large."""

    text: str
    tone: str = ""


@dataclass(frozen=True, kw_only=True)
class Items:
    """A list with a title."""

    items: Sequence[str]
    title: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image or a video. Without `data`, it is a link to the file with the reason why the file is not embedded."""

    caption: str
    alt: str = ""
    film: bool = False
    data: str = ""
    """Data URI."""
    link: str = ""
    reason: str = ""
    wide: bool = False
    """Keep a readable width and scroll on small screens."""
    paper: bool = False
    """The image requires a white background."""
    panel: int | None = None
    """Index of the displayed panel of a video with three panels side by side; None: all panels."""
    head: float = 0.0
    """Height of the header above the panels, divided by the width of the video."""
    same: bool = False
    """The figure shows another panel of the first video in its grid; the script copies the source, so it is embedded once."""


@dataclass(frozen=True, kw_only=True)
class Code:
    """Preformatted text; a click selects all of it for copying."""

    text: str


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Blocks side by side, as many as fit into the width."""

    blocks: Sequence[Block]
    least: int = 17
    """Minimum width of a column, rem."""
    films: bool = False
    """The videos play in step with one control and fill the width."""
    training: float = 0.0
    """Fraction of the videos that is training frames; 0: the control does not show it."""


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Blocks behind a summary; a click shows them."""

    summary: str
    blocks: Sequence[Block]
    open: bool = False


Block = Table | Text | Items | Picture | Code | Grid | Fold


@dataclass(frozen=True, kw_only=True)
class PageSection:
    """A section of the page with an entry in the table of contents."""

    key: str
    """Name in the registry and anchor of the section."""
    title: str
    blocks: Sequence[Block]
    about: str = ""
    folded: bool = False
    """A click on the title shows the section."""


def markdown(blocks: Sequence[Block]) -> str:
    """Tables, paragraphs, lists and code as Markdown. Folds are open; images are omitted."""
    parts = []
    for block in blocks:
        if isinstance(block, Table):
            parts += [
                text for text in (f"## {block.caption}" * bool(block.caption), block.note, lay_out(block, "markdown")) if text
            ]
        elif isinstance(block, Text):
            parts.append(f"**{block.text}**" if block.tone else block.text)
        elif isinstance(block, Items):
            parts += [f"{block.title}:"] if block.title else []
            parts.append("\n".join(f"- {item}" for item in block.items))
        elif isinstance(block, Code):
            parts.append(f"```sh\n{block.text}\n```")
        elif isinstance(block, Fold):
            parts.append(markdown(block.blocks).rstrip("\n"))
    return "\n\n".join(parts) + "\n" if parts else ""


def html_page(title: str, subtitle: str, sections: Sequence[PageSection], *, written: str = "") -> str:
    """The page as HTML; its security policy blocks every request to other files."""
    loader = jinja2.FileSystemLoader(PAGE_TEMPLATES)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {"coded": coded, "lay_out": lay_out}
    texts = {name: Markup((PAGE_TEMPLATES / name).read_text(encoding="utf-8")) for name in ("style.css", "page.js")}
    values = {"title": title, "subtitle": subtitle, "sections": sections, "written": written}
    return environment.get_template("page.html.j2").render(**values, style=texts["style.css"], script=texts["page.js"])
