"""Extras of the installation: errors name the missing extra, and the named extra exists."""

import sys
import tomllib
from pathlib import Path

import pytest

from neuspring.core.errors import InputError
from neuspring.core.extras import EXTRAS, needed

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize(("module", "extra"), EXTRAS.items())
def test_a_package_that_is_missing_is_an_error_that_names_its_extra(module, extra, monkeypatch):
    assert extra in PROJECT["optional-dependencies"]
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"package {module}: the extra \[{extra}\] is required"):
        needed(module)


def test_a_fault_inside_a_package_is_not_taken_for_its_absence(tmp_path, monkeypatch):
    (tmp_path / "newton.py").write_text("import no_such_package")
    monkeypatch.setitem(sys.modules, "newton", None)
    monkeypatch.delitem(sys.modules, "newton")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        needed("newton")
