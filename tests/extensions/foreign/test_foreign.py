"""Installed packages of users, including the example of the extensions page: help, jobs, tables and report contain them."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support import project
from tests.support.desk import FRAMES, camera, counts, seen, write_rig

HERE = Path(__file__).parent
PAGE = project.ROOT / "neuspring" / "extensions" / "README.md"
METHOD = "\nvisiting: {model: lag, description: The mean of the hands.}\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> dict[str, str]:
    """The packages, installed by pip beside NeuSpring; the environment in which all are found."""
    folder = tmp_path_factory.mktemp("foreign")
    source, quoted = folder / "source", folder / "quoted"
    quoted.mkdir()
    for name, text in re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)```", PAGE.read_text(), re.M | re.S):
        (quoted / name).write_text(text)
    assert {path.name for path in quoted.iterdir()} == {"pyproject.toml", "my_springs.py"}
    shutil.copytree(HERE, source, ignore=shutil.ignore_patterns("__pycache__", "*.py"), dirs_exist_ok=True)
    shutil.copytree(HERE / "visitor", source / "visitor", dirs_exist_ok=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(folder / "site"), str(source), str(quoted)], check=True, capture_output=True)
    return {"PYTHONPATH": os.pathsep.join([str(folder / "site"), str(project.ROOT)])}


CALLS = """
import json, sys
from neuspring.cli.main import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit:
        pass
"""


def neuspring(installed, *calls):
    """Calls of the command in one process that finds the packages; returns what they said."""
    command = [sys.executable, "-c", CALLS, json.dumps([list(map(str, words)) for words in calls])]
    environment = os.environ | installed
    return subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True).stdout


def test_its_command_formats_and_captures_are_there(installed, tmp_path):
    pictures = [seen(camera(), frame) for frame in range(FRAMES)]
    np.savez(tmp_path / "film.npz", color=[color for color, _ in pictures], depth=[counts(depth) for _, depth in pictures])
    film, options = tmp_path / "film.npz", ("--rig", write_rig(tmp_path / "rig.json"), "--category", "ball")
    make = ("make-capture", "--color", film, "--depth", film, *options, "--output", tmp_path / "capture")
    said = neuspring(installed, ["--help"], ["greet", "--name", "springs"], ["export", "--help"], make)
    assert "greet             Say hello" in said and "hello springs\n" in said and "xyz" in said
    assert f"{FRAMES} frames" in said and (tmp_path / "capture" / "capture.json").exists()


TERM = """
from neuspring.config import Config, parse
from neuspring.scores.metrics import METRICS
for given in ({}, {"above_table": 2.0}, {"above_table": 0.0}, {"below": 1.0}):
    try:
        losses = parse(Config, {"losses": given}, "configuration").losses
        print(losses.above_table)
    except ValueError as error:
        print(error.args[0].replace("\\n", " "))
print(METRICS["sag"].better, METRICS["sag"].is_error)
"""


def test_the_weight_of_its_loss_is_a_setting_and_its_metric_has_no_best_value(installed):
    command = [sys.executable, "-c", TERM]
    said = subprocess.run(command, env=os.environ | installed, check=True, capture_output=True, text=True).stdout.splitlines()
    assert said[:3] == ["0.0", "2.0", "0.0"] and said[-1] == "neither False"
    assert "losses.below" in said[3]


@pytest.mark.slow
def test_its_baseline_metric_section_and_export_go_through_the_whole_workflow(installed, tmp_path):
    copy = project.copy_workflow(tmp_path / "project")
    methods = copy / "config" / "methods.yaml"
    methods.write_text(methods.read_text() + METHOD)
    project.run(copy, {"methods": ["visiting", "search_only"], "losses": {"above_table": 1.0}}, **installed)
    summary = (copy / "results" / "tables" / "summary.md").read_text()
    assert "Sag" in summary and "visiting" in summary
    assert "A visitor was here." in (copy / "results" / "tables" / "report.html").read_text()
    runs = copy / "results" / project.SCENE
    assert '"sag"' in (runs / "visiting" / "0" / "run.json").read_text()
    neuspring(installed, ["export", runs / "search_only" / "0", "--to", "xyz", "--output", tmp_path / "twin"])
    assert np.loadtxt(tmp_path / "twin.xyz").shape[1] == 3
