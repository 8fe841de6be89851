"""From sections of blocks to one HTML page, by the templates of this package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2
from markupsafe import Markup

from neuspring.report.blocks import SYMBOLS, Section

TEMPLATES = Path(__file__).parent / "templates"


def html_page(title: str, subtitle: str, sections: Sequence[Section], *, written: str = "", embedded: bool = True) -> str:
    """The page as text. `embedded`: nothing but what it contains may be loaded; otherwise files beside it are shown too."""
    loader = jinja2.FileSystemLoader(TEMPLATES)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template("page.html.j2").render(
        title=title,
        subtitle=subtitle,
        written=written,
        sections=sections,
        embedded=embedded,
        symbols=SYMBOLS,
        style=Markup((TEMPLATES / "style.css").read_text(encoding="utf-8")),
        script=Markup((TEMPLATES / "page.js").read_text(encoding="utf-8")),
    )
