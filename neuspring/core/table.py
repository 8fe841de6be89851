"""A table is one value: cells of text, marks and sorting keys, as Markdown and LaTeX; the report's page draws it as HTML."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

Tone = Literal["", "good", "bad", "warn", "mute"]
LONG_GROUPS = {"Recon.": "Reconstruction & Resimulation", "Future": "Future Prediction"}
"""Groups of columns as LaTeX names them, which has room above the columns."""
MARKDOWN_MARKS = {"": "{}", "best": "**{}**", "second": "<ins>{}</ins>"}
LATEX_MARKS = {"": "{}", "best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}
TEX = {
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{character: f"\\{character}" for character in "{}%_&#$"},
    **{"±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "–": "--", "<": r"$<$", ">": r"$>$", "|": r"$|$", "[": "{[}"},
}
LATEX_PREAMBLE = "% Needs \\usepackage{booktabs} and \\usepackage{graphicx}."


@dataclass(frozen=True, kw_only=True)
class Chip:
    """A word on a colored ground, with a symbol, so that nothing is said by color alone."""

    text: str
    tone: Tone = ""
    symbol: str = ""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell: a main text, then smaller texts and chips."""

    text: str = ""
    small: Sequence[str] = ()
    chips: Sequence[Chip] = ()
    mark: Literal["", "best", "second"] = ""
    tone: Tone = ""
    value: float | str | None = None
    """Key by which the column is sorted; None: the text."""
    wrap: bool = False
    """May take several lines."""
    link: str = ""

    @property
    def plain(self) -> str:
        """All of it in one line."""
        text, chips = " ".join([self.text, *self.small]).strip(), ", ".join(chip.text for chip in self.chips)
        return f"{text}: {chips}" if text and chips else text or chips


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table; the first `stub` cells of every row are its headings."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    groups: Sequence[str] = ()
    """Group of each column behind the stub, for example a task; empty: columns are not grouped."""
    stub: int = 1
    sortable: bool = False
    note: str = ""
    """One paragraph."""

    @classmethod
    def of_texts(cls, header: Sequence[str], rows: Iterable[Iterable[str]], caption: str = "") -> Table:
        """A table of plain texts."""
        return cls(caption=caption, header=header, rows=[[Cell(text=text) for text in row] for row in rows])

    @property
    def headings(self) -> list[str]:
        """The header with the group before each heading."""
        rest = self.header[self.stub :]
        grouped = [f"{group} {text}" for group, text in zip(self.groups, rest, strict=True)] if self.groups else rest
        return [*self.header[: self.stub], *grouped]

    def markdown(self) -> list[str]:
        """Lines in which a row with a first cell alone is a heading, which widens no column."""
        rows = [
            [MARKDOWN_MARKS[cell.mark].format(cell.plain.replace("|", "\\|").replace("\n", " ")) for cell in row]
            for row in self.rows
        ]
        several = len(self.header) > 1
        alone = [several and bool(row[0]) and not any(row[1:]) for row in rows]
        widening = [self.headings, *(row for row, heading in zip(rows, alone, strict=True) if not heading)]
        widths = [max(map(len, column)) for column in zip(*widening, strict=True)]
        lines = ["|" + "|".join("-" * (width + 2) for width in widths) + "|"]
        for row, heading in zip(rows, alone, strict=True):
            lines.append(f"| *{row[0]}* |{' |' * (len(row) - 1)}" if heading else _markdown_row(row, widths))
        return [_markdown_row(self.headings, widths), *lines]

    def latex(self, label: str, title: str) -> str:
        """A float to \\input; `LATEX_PREAMBLE` says what it needs. One with groups or a stub of several is as wide as a line."""
        count, stub, numbers = len(self.header), self.stub, bool(self.groups) or self.stub > 1
        head, tail = ("\\small\n\\resizebox{\\linewidth}{!}{%", "}") if numbers else ("\\footnotesize", "")
        spec = f"{'l' * stub} {'r' * (count - stub)}" if numbers else f"{'l' * (count - 1)} p{{0.75\\linewidth}}"
        lines = [f"\\begin{{table*}}[t]\n\\centering\n{head}", f"\\begin{{tabular}}{{@{{}} {spec} @{{}}}}", "\\toprule"]
        if self.groups:
            spans, rules, first = [], [], stub + 1
            for group in dict.fromkeys(self.groups):
                width = list(self.groups).count(group)
                spans.append(f"\\multicolumn{{{width}}}{{c}}{{{tex(LONG_GROUPS.get(group, group))}}}")
                rules.append(f"\\cmidrule(lr){{{first}-{first + width - 1}}}")
                first += width
            lines += [_tex_row(["Task", *[""] * (stub - 1), *spans]), " ".join(rules)]
        lines += [_tex_row([tex(text) for text in self.header]), "\\midrule"]
        blocks = any(not row[0].text for row in self.rows)
        for index, row in enumerate(self.rows):
            # A row without a first cell belongs to the row above.
            lines += ["\\addlinespace"] if index and blocks and row[0].text else []
            lines.append(_tex_row([LATEX_MARKS[cell.mark].format(tex(cell.plain)) for cell in row]))
        caption = f"\\caption{{\\textbf{{{tex(title)}.}} {tex(self.note)}}}"
        lines += ["\\bottomrule", f"\\end{{tabular}}{tail}", caption, f"\\label{{tab:{label}}}", "\\end{table*}"]
        return "\n".join(lines) + "\n"

    @property
    def parts(self) -> list[Table]:
        """A table for each group of columns, for a page, which is narrower than paper on its side."""
        return [self._of_group(group) for group in dict.fromkeys(self.groups)] or [self]

    def _of_group(self, group: str) -> Table:
        kept = [*range(self.stub), *(self.stub + k for k, name in enumerate(self.groups) if name == group)]
        caption = f"{self.caption}: {LONG_GROUPS.get(group, group)}"
        rows = [[row[k] for k in kept] for row in self.rows]
        return replace(self, caption=caption, header=[self.header[k] for k in kept], rows=rows, groups=())


def _markdown_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"


def tex(text: str) -> str:
    """Plain text for LaTeX: special characters escaped, minus signs in mathematics."""
    escaped = "".join(TEX.get(character, character) for character in text)
    return re.sub(r"(?<![\w$.-])-(?=\d)", "$-$", escaped)


def _tex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"
