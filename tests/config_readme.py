"""Writes config/README.md from the configuration's own declarations: python -m tests.config_readme"""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
INTRODUCTION = """# Configuration

`config.yaml` is the default (the demo) and always read first. Overlays merge on top of it, later ones win; nested keys are
set in an overlay:

```
snakemake --profile workflow/profiles/default --cores 2 --quiet rules \\
  --configfile config/mocap.yaml --config data_root=/path/to/data_set
```

Everything is checked before the first job: unknown keys, wrong types (YAML reads `5e-5` as text: write `5.0e-5`), unknown
scenarios and methods, missing data, a results folder that cannot be written. Values are never cast.

- `scenarios.tsv`: one row per capture (toy scenes, motion capture, the 22 PhysTwin scenarios).
- `methods.yaml`: one row per method: the search it starts from, the stage that follows, its own `fit` settings.
- Threads, cores and executors are not configuration: they live on the command line and in `workflow/profiles/`.

This page is written from `neuspring/config.py` by `python -m tests.config_readme`; a test keeps them equal.

## Keys
"""
SECTIONS = {
    "(top level)": "Config",
    "simulation": "Simulation",
    "losses": "Losses",
    "search": "Search",
    "search.ranges": "SearchRanges",
    "search.start": "SearchStart",
    "fit": "Fit",
    "released_quirks": "ReleasedQuirks",
    "toy": "Toy",
    "mocap": "Mocap",
    "tracking": "Tracking",
}


def text() -> str:
    """The page."""
    tree = ast.parse((ROOT / "neuspring" / "config.py").read_text())
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    parts = [INTRODUCTION]
    for title, name in SECTIONS.items():
        summary = (ast.get_docstring(classes[name]) or "").partition("\n")[0]
        rows = [f"| `{key}` | {default} | {meaning} |" for key, default, meaning in fields(classes[name])]
        parts.append("\n".join([f"### {title}", "", summary, "", "| key | default | meaning |", "|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def fields(node: ast.ClassDef) -> list[tuple[str, str, str]]:
    """(key, default, meaning) of every declared field; the meaning is the text below it."""
    found = []
    for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            default = "required" if statement.value is None else ast.unparse(statement.value)
            shown = "" if default.startswith("field(") else f"`{default}`"
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            found.append((statement.target.id, shown, " ".join(str(after.value.value).split()) if is_text else ""))
    return found


if __name__ == "__main__":
    (ROOT / "config" / "README.md").write_text(text())
