"""The table of checks: one list with limits and next steps, equal to the page, with no other kind in the package."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from neuspring import checks, registry
from neuspring.checks import table
from neuspring.core.checks import Check
from tests.support.runs import run_record

ONE = Check(
    "red object", "object and hands", lambda camera, samples: float(len(samples)), (0, 1), "warning", "red pixels", "Repaint.",
    unit="pixels", effect="it is red", needs=("depth",),
)  # fmt: skip


def test_there_are_at_most_45_checks_and_the_page_has_them():
    assert len(table.checks) <= 45
    page = files("neuspring.data").joinpath("README.md").read_text()
    for one in table.checks:
        assert not one.effect or one.name in page
        assert one.effect or one.limit is None, one.name
        assert one.level in ("note", "warning", "error")
    keys = [(one.name, one.of) for one in table.checks]
    assert len(set(keys)) == len(keys)


def test_every_kind_is_asked_for():
    package = Path(checks.__file__).parents[1]
    pattern = r'\bexamine\(\s*"([^"]+)"'
    asked = {kind for path in package.rglob("*.py") for kind in re.findall(pattern, path.read_text())}
    assert {one.of for one in table.checks} <= asked


@pytest.mark.parametrize(
    ("limit", "unit", "value", "words"),
    [
        ((0, 0.1), "%", 0.25, "x: 25 %, at most 10 % expected; e. Do."),
        ((0.05, np.inf), "m", 0.01234, "x: 0.01234 m, at least 0.05 m expected; e. Do."),
        ((0.1, 10), "m", np.float64(768), "x: 768 m, 0.1 to 10 m expected; e. Do."),
        ((-0.5, 0.5), "", 2, "x: 2, at most 0.5 expected; e. Do."),
    ],
)
def test_a_finding_states_value_range_effect_and_next_step(limit, unit, value, words):
    one = Check("n", "k", lambda subject: subject, limit, "error", "x", "Do.", unit=unit, effect="e")
    (found,) = one.findings("file", value)
    assert (found.text, found.level, found.where, found.remedy) == (words, "error", "file", "Do.")
    assert isinstance(found.value, (int, float)) and type(found.value).__module__ == "builtins"
    assert list(one.findings("file", (limit[0] + min(limit[1], 1)) / 2)) == []


def test_a_package_adds_a_check_that_needs_a_stream(monkeypatch):
    monkeypatch.setattr(checks, "CHECKS", registry.Registry("checks", {"mine": ONE}, (Check, tuple)))
    for streams, names in ((None, ["red object"]), (frozenset({"color", "depth"}), ["red object"]), (frozenset({"color"}), [])):
        found = checks.examine("object and hands", "x", None, {1: None, 2: None}, streams=streams)
        assert [one.name for one in found] == names


SETTINGS = {"fit.fit.output_bound": 1.5, "fit.fit.stiffness_range": [0.0, 1e5]}


@pytest.mark.parametrize(
    ("shares", "names"),
    [
        ({"at_bound": 0.91, "at_stiffness_range": 0.02}, ["springs at their bound"]),
        ({"at_stiffness_range": 0.3}, ["springs at the end of the range"]),
        ({"at_bound": 0.05, "at_stiffness_range": 0.0}, []),
        ({}, []),
    ],
)
def test_fits_whose_springs_lie_at_a_limit(shares, names):
    run = run_record(method="model_b", params=SETTINGS | {f"fit.result.{name}": share for name, share in shares.items()})
    found = checks.examine("fit", "model_b/0", run)
    assert [one.name for one in found] == names
    assert "end of the range" not in "".join(names) or "fit={stiffness_range: [0.0, 1000000.0]}" in found[0].remedy
