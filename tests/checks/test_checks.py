"""Checks as data: findings have name, level, value and limit; a package adds a check and a capture format, one object each."""

import json
import re
import shutil
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from neuspring import checks, registry
from neuspring.checks.masks import Shown
from neuspring.core.checks import Check
from neuspring.data.capture import CAPTURE, OBJECT
from neuspring.intake.check import check_layout
from tests.support.filmed import film


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return film(tmp_path_factory.mktemp("filmed") / "film", cameras=1)


def changed(filmed, folder, change):
    """What is said of a copy of the film whose capture.json was changed."""
    path = shutil.copytree(filmed.folder, folder / "film") / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    return {one.name: one for one in check_layout(path.parent)}


def raised(values):
    values["cameras"][0]["camera_to_world"][2][3] += 0.05


@pytest.mark.parametrize(
    ("change", "name", "level", "value", "limit"),
    [
        (raised, "table elsewhere", "warning", 0.05, None),
        (lambda values: values.update(depth_unit=1.0), "depth unit", "error", 800.0, (0.1, 10.0)),
        (lambda values: values.update(frame_rate=3000.0), "frame rate", "error", 3000.0, (1.0, 240.0)),
        (lambda values: values.update(category="Cloth"), "category", "warning", "cloth", None),
    ],
)
def test_a_finding_has_name_level_value_and_limit(filmed, tmp_path, change, name, level, value, limit):
    found = changed(filmed, tmp_path, change)[name]
    assert (found.level, found.limit) == (level, limit)
    assert found.value == (value if isinstance(value, str) else pytest.approx(value, rel=0.3))


def test_frames_are_numbers_too():
    shown = Shown(6, (40, 30))
    for frame in range(6):
        labels = np.zeros((30, 40), np.uint8)
        labels[10:30, 10:16] = OBJECT if frame < 4 else 0
        shown.see(frame, labels)
    found = {one.name: one for one in checks.examine("masks", "camera 0", shown)}
    assert found["object missing"].frames == (4, 5)
    assert found["object at the border"].frames == (0, 1, 2, 3)
    assert (found["no hand in frame 0"].value, found["no hand in frame 0"].level) == (0.0, "warning")


def test_a_cable_whose_marker_jumps(tmp_path):
    positions = np.zeros((8, 3, 7))
    positions[:, 0] = np.linspace(0, 0.6, 7)
    positions[5, 1, 3] = 0.3
    (found,) = (one for one in checks.examine("cable", tmp_path, positions) if one.name == "stretched cable")
    assert (found.level, found.frames) == ("warning", (5,)) and found.value > 2 and found.limit[1] == 0.5


def test_no_check_is_named_twice_for_one_subject_without_another_measure():
    every = [check for name in checks.CHECKS for check in (checks.CHECKS[name] if isinstance(checks.CHECKS[name], tuple) else ())]
    assert len({(check.name, check.of, check.measure) for check in every}) == len(every) > 80


def test_every_kind_of_subject_that_is_examined_has_a_check():
    every = [check for member in checks.CHECKS.values() for check in (member if isinstance(member, tuple) else (member,))]
    package = Path(checks.__file__).parents[1]
    asked = {kind for path in package.rglob("*.py") for kind in re.findall(r'\bexamine\("([^"]+)"', path.read_text())}
    assert asked - {"cases"} == {check.of for check in every} - {"cases"}  # cases: released results alone, an extension


RED = Check(
    "red object",
    "object and hands",
    lambda camera, samples, least: float(np.mean([s.color[s.mask == OBJECT][..., 0].mean() for s in samples.values()])),
    (0, 1),
    "note",
    "red of {value:.0f} in camera {0.name}; up to {high} is usual.",
)


def brought(monkeypatch, group, value):
    """As if an installed package brought a member of a group."""
    point = EntryPoint(name="mine", value=value, group=f"neuspring.{group}")
    real = registry.entry_points
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == point.group else real(group=group))


def test_a_package_adds_a_check(filmed, monkeypatch):
    brought(monkeypatch, "checks", "tests.checks.test_checks:RED")
    own = registry.modules(checks.__name__, "checks")
    monkeypatch.setattr(checks, "CHECKS", registry.Registry("checks", own, (Check, tuple)))
    (found,) = (one for one in check_layout(filmed.folder) if one.name == "red object")
    assert found.level == "note" and found.value > 1 and found.message.startswith("camera 0: red object: red of ")
