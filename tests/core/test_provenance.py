"""Rerun digests follow code, not text."""

import ast
import shutil
import sys
from importlib.util import cache_from_source
from pathlib import Path
from types import SimpleNamespace

import pytest

from neuspring import config
from neuspring.core import provenance
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph
from neuspring.stages import STAGES
from tests.support.extensions import with_extensions

PACKAGE = Path(provenance.__file__).parents[1]
ROOT = PACKAGE.parent


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the package that digests read from."""
    target = tmp_path / "neuspring"
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "PACKAGE_FOLDER", target)
    clear()
    yield target
    clear()


def clear():
    cached = (provenance._source, provenance._code, provenance.imported_modules, provenance._module_code, provenance.code_digest)
    for function in cached:
        function.cache_clear()


def digest(*modules):
    clear()
    return provenance.code_digest(*modules)


def edit(path, old, new):
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))


def test_docstrings_comments_and_layout_do_not_count(copy):
    before = digest("neuspring.twin.fit")
    edit(copy / "twin" / "fit.py", "class NonFinite", "# A comment.\n\nclass NonFinite")
    path = copy / "twin" / "fit.py"
    path.write_text('"""Another docstring."""' + path.read_text().split('"""', 2)[2])
    assert digest("neuspring.twin.fit") == before


@pytest.mark.parametrize(
    ("file", "old", "new", "stage", "others"),
    [
        ("twin/fit.py", "MAX_ROLLBACKS = 5", "MAX_ROLLBACKS = 6", "fit", ("search", "rollout", "score")),
        ("stages/score.py", "epochs rolled back,", "epochs taken back,", "score", ("rollout", "fit")),
        ("stages/render.py", 'VIDEOS = ("video", "turntable")', 'VIDEOS = ("turntable", "video")', "render", ()),
        ("splats/draw.py", "OBJECT_COVERAGE = 128", "OBJECT_COVERAGE = 200", "render", ()),
        ("scores/lpips.py", "SHIFT = (-0.030", "SHIFT = (-0.031", "render", ()),
        ("draw/video.py", "quality: int = 20", "quality: int = 21", "render", ()),
        ("data/capture.py", "[..., ::-1]", "[..., ::1]", "render", ()),
    ],
)
def test_code_counts_where_it_is_used_and_nowhere_else(copy, file, old, new, stage, others):
    """The stage's own, and all that makes its pictures."""
    before = {name: digest(f"neuspring.stages.{name}") for name in (stage, *others)}
    edit(copy / file, old, new)
    assert [name for name in before if digest(f"neuspring.stages.{name}") != before[name]] == [stage]


@with_extensions
def test_modules_that_are_imported_by_name_count(copy):
    """Backends, readers and baselines: the registries name them, and the workflow adds them to the stage that uses them."""
    values = config.read_yaml(ROOT / "config" / "config.yaml")
    config.merge(values, config.read_yaml(ROOT / "config" / "data" / "demo.yaml"))
    graph = Graph(Benchmark(values, ROOT))
    job = SimpleNamespace(scenario=graph.config.scenarios[0], camera="0", method=graph.config.methods[0], seed=0)

    def now(stage):
        clear()
        return graph.made_of(STAGES[stage], job)["code"]

    before = {stage: now(stage) for stage in ("segment", "track", "lift")}
    edit(copy / "perception" / "segment_opencv.py", "import cv2", "import cv2\n\nADDED = 1")
    assert {stage for stage in before if now(stage) != before[stage]} == {"segment"}


def test_transitive_imports_count(copy):
    search, lattice = "neuspring.stages.search", *STAGES["search"].code(config.Config(), {"body": "lattice"})
    before = digest(search, lattice)
    edit(copy / "physics" / "lanes.py", "MIN_SPRING_LENGTH = 1e-6", "MIN_SPRING_LENGTH = 1e-7")
    assert digest(search, lattice) != before
    assert "neuspring.physics.springs" in provenance.used_modules("neuspring.stages.fit")
    assert "neuspring.extensions.rods.solver" not in provenance.used_modules(lattice), "a change of a rod changes no lattice"


def test_declarations_and_reporting_do_not_count(copy):
    before = digest("neuspring.stages.search")
    edit(copy / "core" / "section.py", "Field(ge=1)", "Field(ge=2)")
    edit(copy / "core" / "text.py", "0.2 if", "0.3 if")
    assert digest("neuspring.stages.search") == before


def test_the_digest_is_that_of_every_version_of_python():
    """A newer one gives nodes more fields, which are empty where older code uses nothing new."""
    tree = ast.parse("def f(a=0): return a or None")
    written = provenance._written(tree)
    function = tree.body[0]
    function._fields = (*function._fields, "newer", "parameters")
    function.newer, function.parameters = None, []
    assert provenance._written(tree) == written
    function.newer = "something"
    assert provenance._written(tree) != written
    assert "value=0" in written


def test_modules_of_other_packages_count_with_what_they_import_of_their_own(tmp_path, monkeypatch):
    """A baseline that an installed package adds: its module, and the modules of its package behind it."""
    package = tmp_path / "elsewhere"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "model.py").write_text('"""A model."""\nfrom .rates import RATE\nfrom neuspring.core.text import listed\n')
    (package / "rates.py").write_text("RATE = 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = digest("elsewhere.model")
    assert {"elsewhere.model", "elsewhere.rates", "neuspring.core.text"} <= set(provenance.used_modules("elsewhere.model"))
    edit(package / "model.py", "A model.", "Another text.")
    assert digest("elsewhere.model") == before
    edit(package / "rates.py", "1.0", "2.0")
    assert digest("elsewhere.model") != before


def test_what_is_taken_from_a_module_is_kept_beside_its_bytecode_and_holds_for_its_text_alone(copy, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    before, path = digest("neuspring.twin.fit"), copy / "twin" / "fit.py"
    kept = Path(cache_from_source(str(path))).with_suffix(".json")
    assert digest("neuspring.twin.fit") == before
    monkeypatch.setattr(provenance, "_tree", lambda text: pytest.fail("read again"))
    assert digest("neuspring.twin.fit") == before
    monkeypatch.undo()
    monkeypatch.setattr(provenance, "PACKAGE_FOLDER", copy)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    kept.write_text(kept.read_text()[:-5])
    assert digest("neuspring.twin.fit") == before
    edit(path, "MAX_ROLLBACKS = 5", "MAX_ROLLBACKS = 6")
    assert digest("neuspring.twin.fit") != before
