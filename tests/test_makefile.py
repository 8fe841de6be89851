"""`make install` before pip runs: the selected Python, and an unusable `.venv`."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
OLD = '#!/bin/sh\n[ "$1" = --version ] && echo Python 3.10.9 && exit 0\nexit 1\n'
GOOD = '#!/bin/sh\n[ "$1" = -c ] && exit 0\necho "ran: $@"; exit 3\n'
"""A Python that passes for a new one, and ends when a `.venv` is made of it."""


@pytest.fixture
def folder(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "workflow" / "envs").mkdir(parents=True)
    for name in ("pyproject.toml", "workflow/envs/constraints.txt"):
        (tmp_path / name).touch()
    for name, text in {"old": OLD, "good": GOOD}.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    return tmp_path


def install(folder, python):
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = ["make", "install", f"PYTHON={python}"]
    done = subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True, check=False)
    assert done.returncode
    return done.stdout


@pytest.mark.parametrize(("python", "received"), [("./old", "Python 3.10.9"), ("./nowhere", "")])
def test_a_python_that_does_not_suit_is_named_before_pip_runs(folder, python, received):
    output = install(folder, python)
    assert output.startswith(f"PYTHON={python}: Python 3.11, 3.12 or 3.13 is needed; received {received}")
    assert "Set PYTHON=/path/to/python3.12" in output and not (folder / ".venv").exists()


@pytest.mark.parametrize("wrong", ["old", "/nowhere/python"])
def test_an_environment_whose_python_is_gone_or_too_old_is_replaced_with_a_word(folder, wrong):
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "python").symlink_to(folder / wrong)
    (folder / ".venv" / ".installed").touch()
    assert install(folder, "./old").startswith("PYTHON=./old: "), "nothing is removed for a Python that does not suit"
    assert (folder / ".venv" / ".installed").exists()
    output = install(folder, "./good").splitlines()
    assert output[0] == "Replacing .venv: its Python is missing or not 3.11 to 3.13"
    assert output[-1] == "ran: -m venv .venv" and not (folder / ".venv").exists()
