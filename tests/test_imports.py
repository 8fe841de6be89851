"""Imports: packages import lower levels only, the workflow starts with few modules, no test imports another test."""

import ast
import re
import subprocess
import sys
from pathlib import Path

from neuspring.core import provenance

PACKAGE = Path(provenance.__file__).parents[1]
FLOORS = (
    "extensions > cli > experiments > stages > report > draw > scores baselines > splats perception > scenes > intake > checks > "
    "data > twin > physics config > core"
)
LIGHT = (
    "",
    ".config",
    ".core",
    ".core.provenance",
    ".cli.main",
    ".intake.phystwin",
    ".experiments.benchmark",
    ".experiments.tracking.log",
)
OTHERS = (
    "scipy",
    "sklearn",
    "pandas",
    "pyarrow",
    "matplotlib",
    "cma",
    "optuna",
    "mlflow",
    "cv2",
    "trimesh",
    "snakemake",
    "newton",
    "av",
)
HEAVY = ("torch", "warp", "mlflow", "matplotlib", "cma", "optuna")


def test_imports_go_down_only():
    floor = {room: -index for index, rooms in enumerate(FLOORS.split(" > ")) for room in rooms.split()}
    floor["registry"] = floor["core"]
    upward = []
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if len(parts) == 1:  # the package itself, `python -m neuspring`, the registry
            continue
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        for other in provenance.imported_modules(module):
            room = other.split(".")[1]
            if room != "registry" and room != parts[0] and floor[room] >= floor[parts[0]]:
                upward.append(f"{module} imports {other}")
    assert not upward, "\n".join(upward)


def test_extensions_know_only_the_core():
    """Each can be left out: no other extension imports it, and no page of the core's code names one."""
    for path in PACKAGE.glob("extensions/*/**/*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        others = {name.split(".")[2] for name in provenance.imported_modules(module) if name.startswith("neuspring.extensions.")}
        assert others <= {parts[1]}, module
    core = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "extensions"]
    assert [path for path in core if "neuspring.extensions" in path.read_text()] == []


def test_no_file_of_the_core_names_rods_or_cables():
    """The second body is found by the registry alone."""
    word = re.compile(r"\b(rods?|cables?|deform's|mocap|dlo\d)\b|\bRod[A-Z]", re.IGNORECASE)
    core = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "extensions"]
    lines = [f"{path}: {line.strip()}" for path in core for line in path.read_text().splitlines() if word.search(line)]
    assert not lines, "\n".join(lines)


def test_only_the_tracking_package_imports_mlflow():
    users = {
        path.relative_to(PACKAGE).parent.as_posix()
        for path in PACKAGE.rglob("*.py")
        if "import mlflow" in path.read_text() or "from mlflow" in path.read_text()
    }
    assert users == {"experiments/tracking"}


def test_what_the_workflow_imports_at_its_start_is_light():
    """A module that one of them imports is also imported by all of them together."""
    code = f"""
import importlib, sys
for module in {LIGHT}:
    importlib.import_module("neuspring" + module)
    assert not [name for name in {HEAVY} if name in sys.modules], module
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_twin_and_the_simulator_import_torch_warp_and_numpy_alone():
    """They import no other package that computes or draws; small packages (pydantic, PyYAML, filelock) are allowed."""
    code = f"""
import importlib, sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {OTHERS}:
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
for name in {twin_and_simulator()}:
    importlib.import_module(name)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def twin_and_simulator():
    """Modules of both rooms, but the float64 reference, and what moves a twin to another recording: these stand on SciPy."""
    paths = [path for room in ("physics", "twin") for path in sorted((PACKAGE / room).glob("*.py"))]
    names = [".".join(["neuspring", *path.relative_to(PACKAGE).with_suffix("").parts]) for path in paths]
    return [name.removesuffix(".__init__") for name in names if not name.endswith((".reference", ".register", ".transfer"))]


def test_no_test_imports_another_test_or_a_conftest():
    """Helpers that several test modules use live in tests/support."""
    tests = Path(__file__).parent
    wrong = []
    for path in tests.rglob("*.py"):
        for module in modules_named_in(path):
            if any(part == "conftest" or part.startswith("test_") for part in module.split(".")):
                wrong.append(f"{path.relative_to(tests)} imports {module}")
    assert not wrong, "\n".join(sorted(wrong))


def modules_named_in(path):
    """Every module or name that a file imports, with dots."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module or ''}.{alias.name}" for alias in node.names]
    return names
