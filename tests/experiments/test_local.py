"""The workflow without make: its files in an installation, their location, and the command that runs it."""

import os
import sys
import tomllib
from pathlib import Path

import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.experiments import local

ROOT = Path(__file__).parents[2]
SETUP = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]


def test_an_installation_brings_all_that_the_workflow_reads_and_the_sample_twin():
    places = {
        "Snakefile": "",
        "config": "**/*",
        "workflow/rules": "*.smk",
        "workflow/scripts": "*.py",
        "workflow/profiles/default": "*",
        "workflow/envs": "*",
    }
    needed = {f for name, below in places.items() for f in ((ROOT / name).glob(below) if below else [ROOT / name])}
    needed = {file.relative_to(ROOT) for file in needed if file.is_file() and file.suffix != ".md"}
    brought = {
        file.relative_to(ROOT): place
        for place, patterns in SETUP["data-files"].items()
        for pattern in patterns
        for file in ROOT.glob(pattern)
    }
    assert sorted(needed - brought.keys()) == []
    assert {place for file, place in brought.items() if place != f"share/neuspring/{file.parent}".removesuffix("/.")} == set()
    package = ROOT / "neuspring"
    files = {file for pattern in SETUP["package-data"]["neuspring"] for file in package.glob(pattern)}
    assert {file for file in (package / "data" / "sample_twin").rglob("*") if file.is_file()} <= files


class Placed:
    """A file of an installation."""

    def __init__(self, place):
        self.name, self._place = place.name, place

    def locate(self):
        return self._place


def test_without_a_checkout_it_is_found_where_the_installation_put_it(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "PACKAGE_FOLDER", tmp_path / "lib" / "neuspring")
    snakefile = tmp_path / "share" / "neuspring" / "Snakefile"
    monkeypatch.setattr(local, "files", lambda name: [Placed(tmp_path / "README.md"), Placed(snakefile)])
    with pytest.raises(InputError, match="the package must contain its Snakefile"):
        local.workflow_folder()
    snakefile.parent.mkdir(parents=True)
    snakefile.touch()
    assert local.workflow_folder() == snakefile.parent


@pytest.mark.parametrize("near", [True, False], ids=["in the checkout", "elsewhere"])
def test_the_demo_is_one_command_of_snakemake_with_names_as_they_are_typed_there(near, tmp_path, monkeypatch):
    ran = []
    monkeypatch.chdir(ROOT if near else tmp_path)
    monkeypatch.setattr(os, "execv", lambda program, words: ran.append((program, words)))
    assert main(["demo", "--cores", "3", "--dry-run"]) == 0
    [(program, words)] = ran
    assert program == words[0] == sys.executable and words[-1] == "--dry-run"
    assert words[words.index("--configfile") + 1] == str((Path() if near else ROOT) / "config" / "data" / "demo.yaml")
    assert local.workflow_folder() == ROOT and "--directory" not in words
    assert words[words.index("--cores") + 1] == "3" and all(Path(word).exists() for word in words if word.startswith("/"))
