"""The files that name a force's parameter; another parameter requires changes in these files."""

import ast
from pathlib import Path

import neuspring

PACKAGE = Path(neuspring.__file__).parent
MOST = 8
PLACES = {
    "core/artifacts.py": "the field of Material: unit, meaning, rule",
    "physics/parameters.py": "what the kernels take of it, and whether it has a gradient",
    "physics/motion.py": "the term and its adjoint",
    "physics/frame.py": "where a frame calls them",
    "physics/reference.py": "the specification",
    "config/search.py": "range, scale and start",
    "twin/parameters.py": "how it is trained",
    "twin/bodies/lattice.py": "the equation in words",
}
"""Files that name drag or `decay`, its form in the kernels: a force with one trained parameter requires these files."""
VALUES = {
    "scenes/toy.py": "the drag of the toy's truth",
    "twin/search.py": "the released rounding of drag",
    "extensions/exports/formats/mujoco.py": "drag in MuJoCo",
    "extensions/exports/newton_twin.py": "drag in Newton",
}
"""Files that give or translate the value that drag, which has no default, has in their case. A new parameter has a default."""
OTHERS = {"extensions/synthetic/fem.py", "extensions/synthetic/kernels.py", "extensions/play/page.py"}
"""Drag of another simulator; dragging with a mouse."""


def words(text: str) -> set[str]:
    """Words of a module's code: names, and words of its texts, but not of its docstrings."""
    tree = ast.parse(text)
    documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found: set[str] = set()
    for node in ast.walk(tree):
        found |= {value for key in ("id", "attr", "arg", "name") if isinstance(value := getattr(node, key, None), str)}
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            found |= {word.strip("():,.") for word in node.value.split()}
    return found


def test_a_force_with_one_trained_parameter_has_few_places():
    found = set()
    for path in PACKAGE.rglob("*.py"):
        name, text = path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8")
        if name.startswith("extensions/rods/"):  # a simulator of its own
            continue
        wanted = {"drag", "decay"} if name.startswith("physics/") else {"drag"}
        if any(word in text for word in wanted) and words(text) & wanted:
            found.add(name)
    # An extension may have been left out.
    assert found - VALUES.keys() - OTHERS == {name for name in PLACES if (PACKAGE / name).exists()}
    assert len(PLACES) <= MOST
