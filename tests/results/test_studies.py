"""Published studies: silhouettes of rivals, their shifts, IoU without hands, the selected scenes and methods."""

import importlib
import sys

import numpy as np
import pandas as pd
import pytest

from neuspring.config.parse import read_yaml
from neuspring.data.capture import HANDS, OBJECT, THIN
from neuspring.intake.phystwin import released_cases
from neuspring.scenes.sources import read_scenarios
from results.published.film22.films import MARKS as MARKED
from results.published.film22.films import PREFIX, category_of, marks_of
from results.published.film22.make import (
    BEST,
    CONFIG,
    NEW,
    ROOT,
    fitted_shift,
    iou_without_hands,
    shifted,
    silhouette,
)
from results.published.stand_ins import STAND_INS, StandIn

SCRIPTS = sorted((ROOT / "results" / "published").glob("*/*.py"))


@pytest.mark.parametrize("script", [f"{path.parent.name}.{path.stem}" for path in SCRIPTS])
def test_every_command_runs_in_an_empty_folder(script, tmp_path, monkeypatch):
    """On a stand-in for its data; of what has no command, and of the pictures of the page in a browser, imports are found."""
    module = importlib.import_module(f"results.published.{script}")
    assert (script in STAND_INS) == (hasattr(module, "main") and script != "play.make")
    stand_in = STAND_INS.get(script, lambda _: StandIn([]))(tmp_path)
    for name, value in stand_in.smaller.items():
        monkeypatch.setattr(f"results.published.{name}", value)
    for command in stand_in.commands:
        monkeypatch.setattr(sys, "argv", [script, *map(str, command)])
        module.main()
    for path in tmp_path.glob("out/fits.csv"):
        assert not pd.read_csv(path).duplicated(["beam", "picture", "row", "start"]).any()


def block(rows, columns, shape=(40, 60)):
    mask = np.zeros(shape, bool)
    mask[rows, columns] = True
    return mask


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.5, -2.5)])
def test_a_shift_is_found_again(shift):
    mask = block(slice(10, 22), slice(15, 40)) | block(slice(20, 31), slice(30, 36))
    labels = np.where(shifted(mask, shift), OBJECT, 0).astype(np.uint8)
    assert fitted_shift(mask, labels) == shift


def test_a_silhouette_is_what_differs_from_the_empty_table_with_its_holes_but_not_its_specks_and_shadows():
    table = np.full((40, 60, 3), 150.0, np.float32)
    render = table.astype(np.uint8)
    render[10:30, 10:40] = [120, 130, 100]
    render[15:20, 15:20] = 148
    # Brighter by too little, and of another color at the same brightness.
    render[32:36, 45:55], render[10:30, 40:50] = 140, [165, 150, 135]
    render[2:4, 2:5] = 0
    assert (silhouette(render, table) == block(slice(10, 30), slice(10, 50))).all()


def test_hands_count_on_neither_side():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:20, 10:20] = OBJECT
    labels[10:20, 20:30] = HANDS
    assert iou_without_hands(block(slice(10, 20), slice(10, 30)), labels) == 1
    assert iou_without_hands(block(slice(10, 20), slice(5, 25)), labels) == pytest.approx(100 / 150)


def test_the_study_has_every_released_scene_its_best_row_and_marks_of_frame_0_alone():
    values = read_yaml(CONFIG)
    assert {name.removeprefix(PREFIX) for name in values["scenarios"]} == set(released_cases())
    assert BEST in values["methods"]
    table = read_scenarios(ROOT / "config" / "scenarios.tsv")
    for case in released_cases():
        assert (category_of(case), category_of(case) in THIN) == (table[case].category, table[case].self_collision)
        assert all(mark.frame == 0 for mark in marks_of(case, (640, 362)))
    assert {path.stem for path in (MARKED / "phystwin22_films").glob("*.json")} == set(NEW)
