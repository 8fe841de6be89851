"""Raw RGBD through the real workflow: a synthetic package at the smallest size, and a folder of the user's own.

What the steps compute is tested in tests/stages, without the workflow; here only plans are quick.
"""

import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from neuspring.scores.metrics import METRICS
from tests.support.extensions import with_extensions
from tests.support.filmed import film, write_raw
from tests.support.perceived import final_data, perceived
from tests.support.phystwin_case import dump
from tests.support.project import add_scenario, copy_project, copy_workflow, jobs_in, plan, run

PACKAGE = "synthetic_weird_package"
PERCEPTION = {
    "lift": {"controller_gaps": "rigid", "controller_share": 0.5, "least_controllers": 5, "neighborhood": 0.03},
    "sample": {"voxel": 0.02},
}
SYNTHETIC = {
    "scenarios": [PACKAGE],
    "methods": ["search_only"],
    "compare_with": "search_only",
    "synthetic": {"size": "tiny", "frames": 8},
    "perception": {"segment": {"backend": "opencv"}, **PERCEPTION},
    "images": {"appearance": {"iterations": 40}},
}


@pytest.fixture(scope="module")
def perceived_run(tmp_path_factory):
    """The project folder of a run on a synthetic capture."""
    project = copy_workflow(tmp_path_factory.mktemp("perception") / "project")
    run(project, SYNTHETIC)
    return project


@pytest.mark.slow
def test_a_synthetic_capture_becomes_scores_and_a_table_of_perception(perceived_run):
    results = perceived_run / "results"
    scores = pd.read_csv(results / "tables" / "scores.csv")
    assert set(scores["scenario"]) == {PACKAGE}
    assert scores["value"].notna().all()
    table = pd.read_csv(results / "tables" / "perception.csv")
    # At 120 x 68 pixels, one of which is 5 mm wide.
    assert table["mask_iou_object"][0] > 0.85
    assert table["lifted_median_mm"][0] < 6
    assert table["hull_iou_3"][0] > 0.6
    assert "| package " in (results / "tables" / "perception.md").read_text()


@pytest.mark.slow
def test_a_change_leaves_the_steps_before_it_alone(perceived_run, tmp_path):
    assert plan(perceived_run, SYNTHETIC) == {}
    # What concerns drawing alone does not train again.
    jobs = plan(perceived_run, SYNTHETIC | {"images": {"views": "all", "appearance": {"iterations": 40}}})
    assert "appearance" not in jobs and jobs["run"] == 1
    project = copy_project(perceived_run, tmp_path / "project")
    changes = SYNTHETIC | {"perception": SYNTHETIC["perception"] | {"sample": {"voxel": 0.025}}}
    assert jobs_in(run(project, changes, "--until", "perceive")) == {"perceive": 1}
    [log] = (project / "results" / "jobs" / "perceive").rglob("*.log")
    lines = dict(line.split(": ", 1) for line in log.read_text().splitlines() if ": " in line)
    assert lines["segment"] == lines["track"] == lines["lift"] == lines["judge"] == "already finished" != lines["observe"]


@pytest.mark.slow
def test_predictions_are_drawn_scored_and_filmed(perceived_run):
    run_folder = perceived_run / "results" / PACKAGE / "search_only" / "0"
    scores = pd.read_parquet(run_folder / "scores.parquet")
    pictured = scores[scores["metric"].isin(["psnr", "ssim", "iou"])]
    assert len(pictured) == 6 and set(scores["metric"]) <= set(METRICS)
    assert pictured["value"].between(0, 100).all()
    assert set(scores["metric"]) >= {"chamfer", "track_error", "psnr", "ssim", "iou"}
    record = json.loads((run_folder / "run.json").read_text())
    assert record["images"]["lpips"].startswith("no AlexNet weights")
    assert record["images"]["masks"] == "given"
    pictures = [run_folder / name for name in record["artifacts"]["images"]]
    assert [path.name for path in pictures] == ["appearance.png", "images.png", "video.mp4", "turntable.mp4"]
    assert all(path.stat().st_size > 1000 for path in pictures)
    assert {"appearance", "render"} <= set(record["timings"])
    tracked = {path.name for path in (perceived_run / "results" / "mlartifacts").rglob("*") if path.is_file()}
    assert {"appearance.png", "images.png", "video.mp4", "turntable.mp4", "image_scores.png"} <= tracked
    summary = (perceived_run / "results" / "tables" / "summary.md").read_text()
    assert "Recon. PSNR" in summary
    assert "lpips: no AlexNet weights" in summary
    tables = perceived_run / "results" / "tables"
    page = (tables / "report.html").read_text()
    assert {Path(link).name for link in re.findall(r'href="([^"#]+\.mp4)"', page)} == {"video.mp4", "turntable.mp4"}
    assert "search_only" in page and "IoU" in page
    folder = perceived_run / "results" / PACKAGE / "appearance" / "0"
    assert {path.name for path in folder.iterdir()} == {"appearance.json", "appearance.png", "history.parquet", "splats.ply"}


@pytest.mark.slow
def test_the_truth_lies_beside_the_capture_and_not_in_it(perceived_run):
    folder = perceived_run / "results" / PACKAGE
    assert (folder / "capture_truth.npz").is_file()
    assert {path.name for path in (folder / "capture").iterdir()} == {
        *("capture.json", "capture.record.json", "color", "depth", "mask", "tracks.json")
    }


@pytest.mark.slow
def test_a_folder_of_the_user_s_own_and_masks_that_the_user_repairs(project):
    capture = film(project / "mine" / "film", cameras=2)
    add_scenario(project, "film", "capture")
    changes = {"scenarios": ["film"], "methods": ["search_only"], "compare_with": "search_only", "data_root": str(project / "mine")}
    changes |= {"perception": PERCEPTION, "images": {"appearance": {"iterations": 20}}, "tracking": {"enabled": False}}
    run(project, changes, "--until", "run")
    record = json.loads((project / "results" / "film" / "search_only" / "0" / "run.json").read_text())
    assert record["status"] == "ok"
    # No truth, no table of perception.
    assert "tables" in (left := plan(project, changes)) and "perception_table" not in left

    path = capture.path("mask", "1", 2)
    path.write_bytes(path.read_bytes())
    assert plan(project, changes, "--until", "perceive") == {"perceive": 1}


@pytest.mark.slow
@with_extensions
def test_spring_gaus_has_splats_of_its_own_and_draws_with_them(perceived_run, tmp_path):
    project = copy_project(perceived_run, tmp_path / "project")
    small = {"anchors": 100, "iterations": 1}
    changes = SYNTHETIC | {"methods": ["search_only", "spring_gaus"], "tracking": {"enabled": False}}
    jobs = plan(project, changes | {"baselines": {"spring_gaus": small}})
    # The splats of all methods are there.
    assert (jobs["appearance"], jobs["train"], jobs["run"]) == (1, 1, 1)
    run(project, changes | {"baselines": {"spring_gaus": small}})
    folder = project / "results" / PACKAGE
    assert (folder / "appearance-spring_gaus" / "0" / "splats.ply").is_file()
    record = json.loads((folder / "spring_gaus" / "0" / "run.json").read_text())
    assert record["status"] == "ok"
    assert record["variant"]["model"] == "spring_gaus"
    assert "../../appearance-spring_gaus/0/appearance.json" in record["artifacts"]["records"]
    scores = pd.read_parquet(folder / "spring_gaus" / "0" / "scores.parquet")
    assert set(scores["metric"]) >= {"chamfer", "track_error", "psnr", "ssim", "iou"}
    assert (folder / "spring_gaus" / "0" / "centers.npz").is_file()


@pytest.mark.slow
def test_processed_cases_with_images_beside_them_are_drawn_too(project):
    """PhysTwin's released folders: observations come from final_data.pkl, pictures from color, depth and mask."""
    capture = film(project / "mine" / "film", up="-z")
    observations = perceived(capture, project / "perceived")
    case = write_raw(capture, project / "data" / "film")
    dump(case / "final_data.pkl", final_data(observations))
    add_scenario(project, "film", "phystwin")
    changes = {"scenarios": ["film"], "methods": ["search_only"], "compare_with": "search_only", "data_root": str(project / "data")}
    changes |= {"perception": PERCEPTION | {"segment": {"backend": "opencv"}}, "images": {"appearance": {"iterations": 60}}}
    changes["tracking"] = {"enabled": False}
    # Tables, the report and MLflow treat all runs alike, so that the run's record is enough.
    output = run(project, changes, "--until", "run")
    assert jobs_in(output) == dict.fromkeys(("perceive", "search", "appearance", "run"), 1)
    scores = pd.read_parquet(project / "results" / "film" / "search_only" / "0" / "scores.parquet")
    assert scores.loc[scores["metric"] == "psnr", "value"].min() > 12
    masks = json.loads((project / "results" / "film" / "perception" / "0" / "masks.json").read_text())
    assert masks["settings"]["perception"]["segment"]["backend"] == "given"
    # Without its images the case has no pictures, and the rest runs.
    shutil.rmtree(case / "color")
    assert "appearance" not in plan(project, changes | {"results": "other"})
