"""The registry: names without imports, packages that add members, errors."""

import importlib.metadata
from importlib.metadata import EntryPoint

import pytest

from neuspring import registry
from neuspring.core.errors import InputError
from neuspring.registry import Registry
from tests.support.extensions import with_extensions


def entry(name, value, kind="things"):
    return EntryPoint(name=name, value=value, group=f"neuspring.{kind}")


@pytest.fixture
def packages(monkeypatch):
    """Entry points of installed packages, as a list to fill."""
    points = []
    monkeypatch.setattr(registry, "entry_points", lambda group: [point for point in points if point.group == group])
    return points


def test_ours_come_first_and_a_package_adds_to_them(packages):
    packages += [entry("pi", "math:pi"), entry("e", "math:e"), entry("tau", "math:tau", "others")]
    things = Registry("things", {"two": 2.0, "inf": "math:inf"}, float)
    assert list(things) == ["two", "inf", "e", "pi"] and len(things) == 4
    assert things["inf"] == float("inf") and things["pi"] == pytest.approx(3.14159, abs=1e-5)
    assert "tau" not in things and things.module_of("pi") == "math"


def test_names_are_listed_without_an_import(packages):
    packages.append(entry("broken", "no_such_module:thing"))
    things = Registry("things", {"lazy": "no_module_either:thing"})
    assert list(things) == ["lazy", "broken"]
    with pytest.raises(InputError, match=r"things broken: must be importable; received ModuleNotFoundError"):
        things["broken"]


def test_an_unknown_name_is_told_with_those_that_there_are(packages):
    things = Registry("things", {"one": 1, "two": 2})
    with pytest.raises(InputError, match=r"must be a registered name; received three. Known: one, two"):
        things["three"]
    assert things.get("three") is None


@pytest.mark.parametrize("other", ["math:pi", "math:tau"])
def test_two_packages_cannot_bring_one_name(packages, other):
    packages += [entry("one", other)]
    with pytest.raises(InputError, match="only one package may register the things member one"):
        list(Registry("things", {"one": 1.0}))


def test_a_member_of_another_type_is_refused(packages):
    packages.append(entry("pi", "math:pi"))
    with pytest.raises(InputError, match=r"things pi: must be a str; received float"):
        Registry("things", {}, str)["pi"]


def test_an_extension_of_ours_without_its_folder_is_left_out(packages):
    packages += [entry("play", "neuspring.extensions.no_such_folder.commands:play"), entry("text", "neuspring.core.text:listed")]
    assert list(Registry("things", {})) == ["text"]


@with_extensions
def test_each_entry_point_of_ours_is_there():
    """Names in pyproject.toml are those of members that exist."""
    ours = [point for point in importlib.metadata.distribution("neuspring").entry_points if point.group.startswith("neuspring.")]
    assert ours and all(point.load() for point in ours)
