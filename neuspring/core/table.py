"""Tables as values, and their layout as terminal text, Markdown, LaTeX or HTML."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from markupsafe import Markup, escape

Tone = Literal["", "good", "bad", "warn", "mute"]
Form = Literal["text", "markdown", "latex", "html"]
CELL_MARKS = {
    "text": {"": "{}", "best": "{}", "second": "{}"},
    "markdown": {"": "{}", "best": "**{}**", "second": "<ins>{}</ins>"},
    "latex": {"": "{}", "best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"},
    "html": {"": "{}", "best": "<b>{}</b>", "second": "<u>{}</u>"},
}
TEX = {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{character: f"\\{character}" for character in "{}%_&#$"},
    **{"±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "–": "--", "…": "..."},
    **{"<": r"$<$", ">": r"$>$", "|": r"$|$", "[": "{[}"},
}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell of a table."""

    text: str = ""
    mark: Literal["", "best", "second"] = ""
    tone: Tone = ""
    value: float | str | None = None
    """Sorting key within the column; None: the text."""
    wrap: bool = False
    """Whether the text may be wrapped."""
    link: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table; the first `stub` cells of every row are its headings."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    note: str = ""
    """One paragraph."""
    stub: int = 1

    @classmethod
    def of_texts(cls, header: Sequence[str], rows: Iterable[Iterable[object]], caption: str = "", note: str = "") -> Table:
        """A table of plain texts."""
        return cls(caption=caption, note=note, header=header, rows=[[Cell(text=str(text)) for text in row] for row in rows])

    def markdown(self) -> list[str]:
        """Lines of the table in Markdown, without caption and note."""
        return lay_out(self, "markdown").splitlines()


def lay_out(table: Table, form: Form, label: str = "") -> str:
    """The table in one of four forms; `label` is the LaTeX label. The LaTeX form needs booktabs and graphicx."""
    escaped = {"latex": tex, "html": coded, "markdown": lambda text: text.replace("|", "\\|").replace("\n", " ")}.get(form, str)
    head = [str(escaped(text)) for text in table.header]
    rows = [[CELL_MARKS[form][cell.mark].format(escaped(cell.text)) for cell in row] for row in table.rows]
    if form == "html":
        return _html(table, head, rows)
    if form == "latex":
        return _latex(table, head, rows, label)
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for row in (head, ["-" * width for width in widths], *rows):
        cells = [text.ljust(width) for text, width in zip(row, widths, strict=True)]
        lines.append(f"| {' | '.join(cells)} |" if form == "markdown" else "  ".join(cells).rstrip())
    return "\n".join(lines)


def _latex(table: Table, head: Sequence[str], rows: Sequence[Sequence[str]], label: str) -> str:
    wraps = any(cell.wrap for row in table.rows for cell in row)
    count, begin, end = len(head), "\\footnotesize" if wraps else "\\small\n\\resizebox{\\linewidth}{!}{%", "" if wraps else "}"
    spec = f"{'l' * (count - 1)} p{{0.75\\linewidth}}" if wraps else "l" * table.stub + "r" * (count - table.stub)
    lines = [" & ".join(row) + r" \\" for row in (head, *rows)]
    body = "\n".join(["\\toprule", lines[0], "\\midrule", *lines[1:], "\\bottomrule"])
    caption = f"\\caption{{\\textbf{{{tex(table.caption)}.}} {tex(table.note)}}}\n\\label{{tab:{label}}}"
    tabular = f"{begin}\n\\begin{{tabular}}{{@{{}}{spec}@{{}}}}\n{body}\n\\end{{tabular}}{end}"
    return f"\\begin{{table*}}[t]\n\\centering\n{tabular}\n{caption}\n\\end{{table*}}\n"


def _html(table: Table, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = []
    for cells, texts in zip(table.rows, rows, strict=True):
        made = []
        for k, (cell, text) in enumerate(zip(cells, texts, strict=True)):
            tag, kinds = ("th", ' scope="row"') if k < table.stub else ("td", "")
            if classes := " ".join(filter(None, [cell.tone, "wrap" * cell.wrap])):
                kinds += f' class="{classes}"'
            if cell.value is not None:
                kinds += f' data-value="{escape(cell.value)}"'
            shown = f'<a href="{escape(cell.link)}">{text}</a>' if cell.link else text
            made.append(f"<{tag}{kinds}>{shown}</{tag}>")
        lines.append(f"<tr>{''.join(made)}</tr>")
    heads = "".join(f'<th scope="col">{text}</th>' if text else "<td></td>" for text in head)
    caption = f"<caption><span>{coded(table.caption)}</span></caption>" if table.caption else ""
    begin = f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(table.caption)}"><table class="sortable">'
    note = f'\n<p class="note">{coded(table.note)}</p>' if table.note else ""
    body = "\n".join(lines)
    return Markup(f"{begin}{caption}\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>{note}")


def coded(text: str) -> Markup:
    """Escaped text with `code` between backticks."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def tex(text: str) -> str:
    """Plain text for LaTeX: special characters are escaped, minus signs are in math mode."""
    escaped = "".join(TEX.get(character, character) for character in text)
    return re.sub(r"(?<![\w$.-])-(?=\d)", "$-$", escaped)
