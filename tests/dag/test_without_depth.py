"""Captures without depth through the real workflow: a painted cloth in color alone, and points in space without a camera."""

import json

import numpy as np
import pandas as pd
import pytest

from neuspring.core.artifacts import Observations, Twin
from neuspring.data.capture import POINTS
from neuspring.intake.points import Hands, write
from tests.support import spaced as scene
from tests.support.colored import paint
from tests.support.extensions import with_extensions
from tests.support.project import add_scenario, plan, run
from tests.support.spaced import spaced

COLOR = {
    "scenarios": ["painted"],
    "methods": ["static", "neuspring"],
    "compare_with": "static",
    "search": {"rollouts": 14},
    "fit": {"epochs": 1},
    "perception": {"segment": {"backend": "given"}, "sample": {"voxel": 0.02, "nodes": 60}},
    "images": {"appearance": {"iterations": 20, "spacing": 2.0}, "video": False},
    "tracking": {"enabled": False},
}


@with_extensions
@pytest.mark.slow
def test_color_alone_becomes_scores_of_pictures_and_marked_points(project, tmp_path):
    capture = paint(tmp_path / "data" / "painted", frames=10)
    corner = next(iter(capture.cameras.values())).project(np.array([[0.08, -0.08, 0.002]]))[0][0].tolist()
    (capture.folder / POINTS).write_text(json.dumps({"0": [[corner] + [None] * 8 + [corner]]}))
    add_scenario(project, "painted", "capture")
    table = project / "config" / "scenarios.tsv"
    table.write_text(table.read_text().replace("\tcapture\ttoy\t", "\tcapture\tcloth\t"))
    run(project, COLOR | {"data_root": str(tmp_path / "data")})
    folder = project / "results" / "demo" / "painted"
    folder = folder if folder.is_dir() else project / "results" / "painted"
    assert Observations.load(folder / "observations.npz").image is not None
    scores = pd.read_parquet(folder / "neuspring" / "0" / "scores.parquet")
    # Without depth there is nothing in space to compare with.
    assert set(scores["metric"]) >= {"iou", "psnr", "ssim", "image_error"}
    assert not {"chamfer", "track_error"} & set(scores["metric"])
    # The cloth hardly moves: its near corner stays where it is.
    assert scores.set_index("metric").loc["image_error", "value"] < 5
    assert (folder / "perception" / "hands.png").exists()
    summaries = [path.read_text() for path in project.rglob("summary.md")]
    assert any("Errors of annotated points" in text for text in summaries)


@pytest.mark.slow
def test_points_alone_become_scores_and_changed_hands_are_noticed(project, tmp_path):
    capture = spaced(tmp_path / "data" / "lifted")
    changes = {"scenarios": ["lifted"], "methods": ["search_only"], "images": {"video": False}, "tracking": {"enabled": False}}
    changes["data_root"] = str(tmp_path / "data")
    run(project, changes)
    folder = next(project.rglob("observations.npz")).parent
    seen = Observations.load(folder / "observations.npz")
    assert seen.scenario.source == "points"
    assert len(Twin.load(next(folder.glob("search-*/0/twin.npz"))).topology.nodes) == len(seen.nodes)
    scores = pd.read_parquet(folder / "search_only" / "0" / "scores.parquet")
    # The points rise by 5 mm a frame; what the hands hold follows them, and what is frozen does not.
    mine = scores[scores["metric"] == "track_error"].set_index("task")["value"]
    frozen = pd.read_parquet(folder / "static" / "0" / "scores.parquet")
    still = frozen[frozen["metric"] == "track_error"].set_index("task")["value"]
    assert set(mine.index) == set(still.index) == {"reconstruction", "future"}
    assert (mine < still).all()
    assert not set(scores["metric"]) & {"psnr", "iou", "image_error"}
    assert plan(project, changes) == {}
    write(capture.folder, Hands(scene.risen(scene.GRIP, 8) + 0.001, np.zeros((0, 0), bool), np.zeros(0, int)), scene.NODES)
    assert plan(project, changes).keys() >= {"perceive", "search", "run"}
