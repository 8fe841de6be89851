"""Markdown of other commands as HTML of this page. Raw HTML in it is shown as text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup, escape

from neuspring.report.blocks import Block, Fold, Grid, Picture, Prose, Section
from neuspring.report.page.media import embedded_png, link
from neuspring.report.page.sources import UNREADABLE, Material

DATA = (".md", ".csv", ".tex", ".html", ".parquet")
SO_FAR = "so_far"
"""Folder of tables that an interrupted run left."""


def render(text: str, picture: Callable[[str], str]) -> Markup:
    """Markdown as HTML with smaller headings. `picture` returns the data URI of a picture that the text names, or nothing."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")

    def image(_: Any, tokens: Sequence[Any], index: int, *rest: Any) -> str:
        token = tokens[index]
        source = picture(str(token.attrs.get("src", "")))
        alt = escape(token.content)
        return f'<img class="paper" alt="{alt}" src="{escape(source)}">' if source else f"<em>{alt}</em>"

    def opened(*_: Any) -> str:
        return '<div class="scroll" tabindex="0" role="region" aria-label="Table"><table>'

    parser.add_render_rule("image", image)
    parser.add_render_rule("table_open", opened)
    parser.add_render_rule("table_close", lambda *_: "</table></div>")
    tokens = parser.parse(text)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = "h3" if token.tag in ("h1", "h2") else "h4"
    return Markup(parser.renderer.render(tokens, parser.options, {}))


def file(material: Material, path: Path) -> tuple[Prose | None, set[Path]]:
    """A Markdown file, and the pictures in it that were embedded; None if it is not there or cannot be read."""
    shown: set[Path] = set()

    def picture(source: str) -> str:
        place = path.parent / source
        png = embedded_png(place) if "://" not in source and place.suffix == ".png" else None
        if png is None:
            return ""
        shown.add(place.resolve())
        return png.uri

    if not path.is_file():
        return None, shown
    try:
        return Prose(html=render(path.read_text(encoding="utf-8"), picture)), shown
    except UNREADABLE as error:
        material.lost(path, error)
        return None, shown


def tuning(material: Material) -> Section | None:
    """The sweeps under results/tune; None without any."""
    folds: list[Block] = []
    for path in sorted((material.results / "tune").glob("*/summary.md")):
        text, shown = file(material, path)
        if text is None:
            continue
        drawings = [drawing for drawing in sorted(path.parent.glob("*.png")) if drawing.resolve() not in shown]
        pictures = [_picture(drawing, png.uri, png.size) for drawing in drawings if (png := embedded_png(drawing))]
        folds.append(Fold(summary=path.parent.name, blocks=[text, Grid(blocks=pictures, least=26)], open=not folds))
    return Section(key="tuning", title="Tuning", blocks=folds) if folds else None


def _picture(path: Path, uri: str, size: tuple[int, int]) -> Block:
    name = path.stem.replace("_", " ")
    return Picture(caption=name, alt=f"{name}, study {path.parent.name}", data=uri, size=size, paper=True)


def files(material: Material) -> list[tuple[str, str]]:
    """Files of the tables' folder beside the report: text and link."""
    folder, here = material.results / material.tables, material.output.resolve()
    paths = (path for path in sorted(folder.rglob("*")) if path.suffix in DATA and path.resolve() != here)
    paths = (path for path in paths if path.is_file() and SO_FAR not in path.relative_to(folder).parts)
    return [(material.relative(path), link(path, here.parent)) for path in paths]


def perception(material: Material) -> Section | None:
    """Perception against the truth of synthetic captures; None where it was not judged."""
    text, _ = file(material, material.results / material.tables / "perception.md")
    return Section(key="perception", title="Perception", blocks=[text]) if text else None
