"""Color alone through the real workflow: a painted cloth that a hand lifts, one camera, no depth."""

import json

import numpy as np
import pandas as pd
import pytest

from neuspring.core.artifacts import Observations
from neuspring.data.capture import POINTS
from tests.support.colored import paint
from tests.support.project import add_scenario, copy_workflow, run

CHANGES = {
    "scenarios": ["painted"],
    "methods": ["static", "controller_lbs", "search_only", "baseline", "neuspring"],
    "compare_with": "baseline",
    "search": {"rollouts": 14},
    "fit": {"epochs": 1},
    "perception": {"segment": {"backend": "given"}, "sample": {"voxel": 0.02, "nodes": 60}},
    "images": {"appearance": {"iterations": 20, "spacing": 2.0}, "video": False},
    "tracking": {"enabled": False},
}


@pytest.mark.slow
def test_color_alone_becomes_scores_of_pictures_and_marked_points(tmp_path):
    capture = paint(tmp_path / "data" / "painted", frames=10)
    corner = next(iter(capture.cameras.values())).project(np.array([[0.08, -0.08, 0.002]]))[0][0].tolist()
    (capture.folder / POINTS).write_text(json.dumps({"0": [[corner] + [None] * 8 + [corner]]}))
    project = copy_workflow(tmp_path / "project")
    add_scenario(project, "painted", "capture")
    table = project / "config" / "scenarios.tsv"
    table.write_text(table.read_text().replace("\tcapture\ttoy\t", "\tcapture\tcloth\t"))
    run(project, CHANGES | {"data_root": str(tmp_path / "data")})
    folder = project / "results" / "demo" / "painted"
    folder = folder if folder.is_dir() else project / "results" / "painted"
    observations = Observations.load(folder / "observations.npz")
    assert observations.image is not None
    scores = pd.read_parquet(folder / "neuspring" / "0" / "scores.parquet")
    # Without depth there is nothing in space to compare with.
    assert set(scores["metric"]) >= {"iou", "psnr", "ssim", "image_error"}
    assert not {"chamfer", "track_error"} & set(scores["metric"])
    # The cloth hardly moves: its near corner stays where it is.
    assert scores.set_index("metric").loc["image_error", "value"] < 5
    assert (folder / "perception" / "hands.png").exists()
    summaries = [path.read_text() for path in project.rglob("summary.md")]
    assert any("Points marked in images" in text for text in summaries)
