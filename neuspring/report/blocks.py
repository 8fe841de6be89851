"""The parts of a page as values: HTML by a template, which escapes every text; tables, paragraphs and lists also as Markdown."""

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
    """A paragraph; `tone` makes it a note, "lead" a large one."""

    text: str
    tone: str = ""


@dataclass(frozen=True, kw_only=True)
class Items:
    """A list below a title."""

    items: Sequence[str]
    title: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture or a film; without `data`, a link to the file and the reason why it is not embedded."""

    caption: str
    alt: str = ""
    film: bool = False
    data: str = ""
    """Data URI."""
    link: str = ""
    reason: str = ""
    wide: bool = False
    """Keeps a readable width, and scrolls on small screens."""
    paper: bool = False
    """Drawn for a white page."""
    panel: int | None = None
    """The panel that is shown of a film of three side by side; None: all of it."""
    head: float = 0.0
    """Height of what is above the panels, over the width of the film."""
    same: bool = False
    """Another panel of the first film beside it; the page's script adds it, so that no film is there twice."""


@dataclass(frozen=True, kw_only=True)
class Code:
    """Preformatted text; a click selects all of it, to be copied."""

    text: str


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Blocks side by side, as many as fit."""

    blocks: Sequence[Block]
    least: int = 17
    """Smallest width of a column, rem."""
    films: bool = False
    """The videos among them play in step, with one control, and fill the width."""
    training: float = 0.0
    """Share of the films that is training; 0: the control does not show it."""


@dataclass(frozen=True, kw_only=True)
class Fold:
    """Blocks that are shown on a click."""

    summary: str
    blocks: Sequence[Block]
    open: bool = False


Block = Table | Text | Items | Picture | Code | Grid | Fold


@dataclass(frozen=True, kw_only=True)
class PageSection:
    """A part of the page with an entry in its table of contents."""

    key: str
    """Its name in the registry, and in links to it."""
    title: str
    blocks: Sequence[Block]
    about: str = ""
    folded: bool = False
    """Shown on a click on its title."""


def markdown(blocks: Sequence[Block]) -> str:
    """Tables, paragraphs, lists and code as Markdown; folds are open. Pictures are left out."""
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
    """The page as text; nothing but what it contains may be loaded."""
    loader = jinja2.FileSystemLoader(PAGE_TEMPLATES)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {"coded": coded, "lay_out": lay_out}
    texts = {name: Markup((PAGE_TEMPLATES / name).read_text(encoding="utf-8")) for name in ("style.css", "page.js")}
    values = {"title": title, "subtitle": subtitle, "sections": sections, "written": written}
    return environment.get_template("page.html.j2").render(**values, style=texts["style.css"], script=texts["page.js"])
