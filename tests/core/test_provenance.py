"""Rerun digests follow code, not text; and imports point one way."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from neuspring.core import provenance

PACKAGE = Path(provenance.__file__).parent


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the package that digests read from."""
    target = tmp_path / "neuspring"
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "ROOT", target)
    clear()
    yield target
    clear()


def clear():
    cached = (provenance._source, provenance._tree, provenance.imported_modules, provenance._module_code, provenance.code_digest)
    for function in cached:
        function.cache_clear()


def digest(module: str) -> str:
    clear()
    return provenance.code_digest(module)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))


def test_docstrings_comments_and_layout_do_not_count(copy):
    before = digest("neuspring.twin.fit")
    edit(copy / "fit.py", "Runs epochs.", "Runs its epochs.")
    edit(copy / "fit.py", "class NonFinite", "# A comment.\n\nclass NonFinite")
    assert digest("neuspring.twin.fit") == before


def test_code_counts_where_it_is_used_and_nowhere_else(copy):
    before = {name: digest(f"neuspring.{name}") for name in ("search", "fit", "metrics", "tables")}
    edit(copy / "fit.py", "MAX_ROLLBACKS = 5", "MAX_ROLLBACKS = 6")
    assert digest("neuspring.twin.fit") != before["fit"]
    assert {name: digest(f"neuspring.{name}") for name in ("search", "metrics", "tables")} == {
        name: before[name] for name in ("search", "metrics", "tables")
    }


def test_a_stage_counts_with_the_functions_it_calls_and_no_other(copy):
    def stage(name: str) -> str:
        clear()
        return provenance.code_digest("neuspring.scores.metrics", stage=name)

    before = {name: stage(name) for name in ("transfer", "score", "rollout")}
    assert before["score"] != digest("neuspring.scores.metrics")
    edit(copy / "stages.py", '"""What a reader of the scores', '"""What any reader of the scores')
    assert {name: stage(name) for name in before} == before
    # A helper that score calls, and no other of the three.
    edit(copy / "stages.py", "epochs rolled back,", "epochs taken back,")
    assert {name for name in before if stage(name) != before[name]} == {"score"}


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("pictures.py", "COVERED = 128", "COVERED = 200"),
        ("lpips.py", "SHIFT = (-0.030", "SHIFT = (-0.031"),
        ("video.py", "quality: int = 20", "quality: int = 21"),
        ("splats/train.py", "> opacity", ">= opacity"),
        ("appearance.py", 'VIDEOS = ("video", "turntable")', 'VIDEOS = ("turntable", "video")'),
        ("data/capture.py", "[..., ::-1]", "[..., ::1]"),
    ],
)
def test_everything_that_makes_pictures_counts(copy, file, old, new):
    """The modules that rule `render` names, and constants beside its function."""
    rule = (PACKAGE.parent / "workflow" / "rules" / "images.smk").read_text().partition("rule render")[2]
    modules = [word.strip('", ') for word in rule.partition("code_digest(")[2].partition("stage=")[0].split()]

    def now() -> str:
        clear()
        return provenance.code_digest(*modules, stage="appearance.render")

    before = now()
    edit(copy / file, old, new)
    assert now() != before


def test_transitive_imports_count(copy):
    before = digest("neuspring.twin.search")
    edit(copy / "physics" / "springs.py", "MIN_LENGTH = 1e-6", "MIN_LENGTH = 1e-7")
    assert digest("neuspring.twin.search") != before
    assert "neuspring.physics.springs" in provenance.used_modules("neuspring.twin.fit")


def test_declarations_and_reporting_do_not_count(copy):
    before = digest("neuspring.twin.search")
    edit(copy / "config.py", "max_substeps: Count = 2000", "max_substeps: Count = 2001")
    edit(copy / "progress.py", "0.2 if", "0.3 if")
    assert digest("neuspring.twin.search") == before


LEVELS = [
    {"errors"},
    {"files"},
    {"config_types"},
    {"config_perception", "config_images", "config_gpus", "config_tune", "config_spring_gaus", "config_gs_dynamics"},
    {"config_baselines"},
    {"artifacts", "config", "progress", "kernels", "faults", "gpus"},
    {"records", "topology", "physics", "losses", "metrics", "provenance", "field", "motion", "points", "figures_views", "paper"},
    {"checkpoint", "weight_files"},
    {
        "image_metrics",
        "lpips_weights",
        "vgg16_weights",
        "video",
        "job_records",
        "studies",
        "watch",
        "tracking_store",
        "tables_layout",
    },
    {
        "rollout",
        "data",
        "tracking_query",
        "tracking_payload",
        "parameters",
        "transfer",
        "figures_twin",
        "figures_clusters",
        "figures_ratios",
        "tables_held",
        "figures_tune",
        "splats",
        "lpips",
        "plan",
        "job",
    },
    {"tracking", "benchmark", "perception", "search", "fit", "carry", "figures", "tables", "gallery"},
    {"perceive", "tables_perception", "figures_images", "tables_cells", "tables_render", "needs"},
    {"pictures", "tables_paper"},
    {"baselines"},
    {"stages", "stages_baselines", "appearance", "verify", "compare", "tune_space", "tune_store"},
    {"explain", "report", "tune_trial", "tune_records"},
    {"tune", "tune_report", "explain_text"},
    {"cli_options"},
    {"cli_tools"},
    {"cli"},
    {"__main__"},
]


def test_imports_point_one_way():
    level = {name: index for index, names in enumerate(LEVELS) for name in names}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts == ("__init__",):
            continue
        assert parts[0] in level, f"give {parts[0]} a place in LEVELS"
        module = ".".join(["neuspring", *(part for part in parts if part != "__init__")])
        for other in provenance.imported_modules(module):
            target = other.split(".")[1]
            assert target == parts[0] or level[target] < level[parts[0]], f"{module} imports {other}"


def test_only_the_tracking_modules_import_mlflow():
    users = [
        path.name for path in PACKAGE.rglob("*.py") if "import mlflow" in path.read_text() or "from mlflow" in path.read_text()
    ]
    assert users
    assert all(name.startswith("tracking") for name in users), users


LIGHT = [f"neuspring{name}" for name in ("", ".benchmark", ".config", ".cli", ".provenance", ".tracking", ".data.phystwin")]


@pytest.mark.parametrize("module", LIGHT)
def test_imports_that_the_workflow_makes_at_start_are_light(module):
    code = f"import sys, {module}; print([m for m in ('torch', 'warp', 'mlflow', 'matplotlib', 'cma') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_a_commit_is_found_by_the_names_that_git_knows():
    if not (here := provenance.commit().removesuffix("-dirty")):
        pytest.skip("not a working copy")
    assert provenance.commit_named("HEAD") == provenance.commit_named(here[:10]) == here
    assert provenance.commit_named("no-such-commit") == "no-such-commit"
    assert provenance.commit_named(f"{here}-dirty") == f"{here}-dirty"
