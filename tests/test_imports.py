"""Who imports whom: rooms of the package import downwards only, the workflow starts light, and no test imports another test."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from neuspring.core import provenance

PACKAGE = Path(provenance.__file__).parents[1]
FLOORS = (
    "cli > export experiments play > stages > report > scores baselines > splats perception > data > twin > physics config > core"
)
LIGHT = (
    "",
    ".config",
    ".core",
    ".core.provenance",
    ".cli.main",
    ".data.phystwin",
    ".experiments.benchmark",
    ".experiments.tracking.log",
)
HEAVY = ("torch", "warp", "mlflow", "matplotlib", "cma", "optuna")


def test_imports_go_down_only():
    floor = {room: -index for index, rooms in enumerate(FLOORS.split(" > ")) for room in rooms.split()}
    upward = []
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if len(parts) == 1:  # the package itself, and `python -m neuspring`
            continue
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        for other in provenance.imported_modules(module):
            room = other.split(".")[1]
            if room != parts[0] and floor[room] >= floor[parts[0]]:
                upward.append(f"{module} imports {other}")
    assert not upward, "\n".join(upward)


def test_only_the_tracking_package_imports_mlflow():
    users = {
        path.relative_to(PACKAGE).parent.as_posix()
        for path in PACKAGE.rglob("*.py")
        if "import mlflow" in path.read_text() or "from mlflow" in path.read_text()
    }
    assert users == {"experiments/tracking"}


@pytest.mark.parametrize("module", LIGHT)
def test_what_the_workflow_imports_at_its_start_is_light(module):
    code = f"import sys, neuspring{module}; print([name for name in {HEAVY} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_no_test_imports_another_test_or_a_conftest():
    """Helpers that several test modules use live in tests/support."""
    tests = Path(__file__).parent
    wrong = []
    for path in tests.rglob("*.py"):
        for module in modules_named_in(path):
            if any(part == "conftest" or part.startswith("test_") for part in module.split(".")):
                wrong.append(f"{path.relative_to(tests)} imports {module}")
    assert not wrong, "\n".join(sorted(wrong))


def modules_named_in(path: Path) -> list[str]:
    """Every module or name that a file imports, with dots."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module or ''}.{alias.name}" for alias in node.names]
    return names
