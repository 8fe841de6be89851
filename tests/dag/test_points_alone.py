"""Points in space alone through the real workflow: no row of the table, no camera; hands that change make it run again."""

import numpy as np
import pandas as pd
import pytest

from neuspring.core.artifacts import Observations, Twin
from neuspring.intake.points import Hands, write
from tests.support import spaced as scene
from tests.support.project import plan, run
from tests.support.spaced import spaced

CHANGES = {"scenarios": ["lifted"], "methods": ["search_only"], "images": {"video": False}, "tracking": {"enabled": False}}


@pytest.mark.slow
def test_points_alone_become_scores_and_changed_hands_are_noticed(project, tmp_path):
    capture = spaced(tmp_path / "data" / "lifted")
    changes = CHANGES | {"data_root": str(tmp_path / "data")}
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
    assert plan(project, changes).keys() >= {"observe", "search", "score"}
