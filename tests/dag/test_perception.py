"""Raw RGBD through the real workflow: a synthetic package at the smallest size, and a folder of the user's own."""

import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from tests.support.filmed import film, write_raw
from tests.support.perceived import final_data, perceived
from tests.support.phystwin_case import dump
from tests.support.project import copy_finished, copy_workflow, jobs, run

PACKAGE = "synthetic_weird_package"
PERCEPTION = {
    "lift": {"controller_gaps": "rigid", "controller_share": 0.5, "least_controllers": 5, "neighbourhood": 0.03},
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
def finished(tmp_path_factory):
    project = copy_workflow(tmp_path_factory.mktemp("perception") / "project")
    result = run(project, SYNTHETIC)
    assert result.returncode == 0, result.stdout + result.stderr
    return project


def test_a_synthetic_capture_becomes_scores_and_a_table_of_perception(finished):
    results = finished / "results"
    scores = pd.read_parquet(results / "tables" / "scores.parquet")
    assert set(scores["scenario"]) == {PACKAGE}
    assert scores["value"].notna().all()
    table = pd.read_csv(results / "tables" / "perception.csv")
    # At 120 x 68 pixels, one of which is 5 mm wide.
    assert table["mask_iou_object"][0] > 0.85
    assert table["lifted_median_mm"][0] < 6
    assert table["hull_iou_3"][0] > 0.6
    assert "| package " in (results / "tables" / "perception.md").read_text()


def test_cameras_are_perceived_by_jobs_of_their_own_and_nothing_reruns(finished):
    assert "Nothing to be done" in (again := run(finished, SYNTHETIC, "--dry-run")).stdout + again.stderr
    planned = jobs(run(finished, SYNTHETIC | {"results": "other"}, "--dry-run"))
    assert (planned["synthesise"], planned["segment"], planned["track"], planned["lift"], planned["observe"]) == (1, 3, 3, 1, 1)
    # A change of the last step leaves the steps before it alone.
    changed = SYNTHETIC | {"perception": SYNTHETIC["perception"] | {"sample": {"voxel": 0.025}}}
    planned = jobs(run(finished, changed, "--dry-run"))
    assert "lift" not in planned
    assert planned["observe"] == 1


def test_predictions_are_drawn_scored_and_filmed(finished):
    run_folder = finished / "results" / PACKAGE / "search_only" / "0"
    scores = pd.read_parquet(run_folder / "scores.parquet")
    pictured = scores[scores["metric"].isin(["psnr", "ssim", "iou"])]
    assert len(pictured) == 6
    assert pictured["value"].between(0, 100).all()
    assert set(scores["metric"]) == {"chamfer", "track_error", "psnr", "ssim", "iou"}
    record = json.loads((run_folder / "run.json").read_text())
    assert record["images"]["lpips"].startswith("no AlexNet weights")
    assert record["images"]["masks"] == "given"
    pictures = [run_folder / name for name in record["artifacts"]["images"]]
    assert [path.name for path in pictures] == ["appearance.png", "images.png", "video.mp4", "turntable.mp4"]
    assert all(path.stat().st_size > 1000 for path in pictures)
    assert {"appearance", "render"} <= set(record["timings"])
    tracked = {path.name for path in (finished / "results" / "mlartifacts").rglob("*") if path.is_file()}
    assert {"appearance.png", "images.png", "video.mp4", "turntable.mp4", "image_scores.png"} <= tracked
    summary = (finished / "results" / "tables" / "summary.md").read_text()
    assert "Recon. PSNR" in summary
    assert "LPIPS not computed: no AlexNet weights" in summary
    tables = finished / "results" / "tables"
    page = (tables / "pictures.html").read_text()
    links = re.findall(r'src="([^"]+)"', page)
    assert {Path(link).name for link in links} == {"video.mp4", "turntable.mp4", "appearance.png"}
    assert all((tables / link).is_file() for link in links)
    assert "search_only" in page and "dB" in page
    folder = finished / "results" / PACKAGE / "appearance" / "0"
    assert {path.name for path in folder.iterdir()} == {"appearance.json", "appearance.png", "history.parquet", "splats.ply"}


def test_all_methods_share_one_appearance(finished):
    changes = SYNTHETIC | {"methods": ["search_only", "baseline", "neuspring"], "seeds": [0, 1]}
    planned = jobs(run(finished, changes | {"results": "other"}, "--dry-run"))
    assert (planned["appearance"], planned["render"], planned["score"]) == (2, 6, 6)
    # What concerns drawing alone does not train again; a run without images has no such steps.
    planned = jobs(run(finished, SYNTHETIC | {"images": {"views": "all", "appearance": {"iterations": 40}}}, "--dry-run"))
    assert "appearance" not in planned
    assert (planned["render"], planned["score"]) == (1, 1)
    quirk = {"released_quirks": {"any_alpha": True}, "appearance": {"iterations": 40}}
    assert "appearance" not in jobs(run(finished, SYNTHETIC | {"images": quirk}, "--dry-run"))
    planned = jobs(run(finished, SYNTHETIC | {"results": "other", "images": {"enabled": False}}, "--dry-run"))
    assert "render" not in planned


def test_spring_gaus_has_splats_of_its_own_and_draws_with_them(finished, tmp_path):
    project = copy_finished(finished, tmp_path / "project")
    small = {"anchors": 100, "iterations": 1, "substeps": 100}
    changes = SYNTHETIC | {"methods": ["search_only", "spring_gaus", "spring_gaus_ignore_hands"], "tracking": {"enabled": False}}
    planned = jobs(run(project, changes | {"baselines": {"spring_gaus": small}}, "--dry-run"))
    # Both variants share their splats; those of all methods are there.
    assert (planned["appearance"], planned["train"], planned["predict"], planned["render"]) == (1, 2, 2, 2)
    changes["methods"] = ["search_only", "spring_gaus"]
    result = run(project, changes | {"baselines": {"spring_gaus": small}})
    assert result.returncode == 0, result.stdout + result.stderr
    folder = project / "results" / PACKAGE
    assert (folder / "appearance-spring_gaus" / "0" / "splats.ply").is_file()
    record = json.loads((folder / "spring_gaus" / "0" / "run.json").read_text())
    assert record["status"] == "ok"
    assert record["variant"]["model"] == "spring_gaus"
    assert "../../appearance-spring_gaus/0/appearance.json" in record["artifacts"]["records"]
    scores = pd.read_parquet(folder / "spring_gaus" / "0" / "scores.parquet")
    assert set(scores["metric"]) == {"chamfer", "track_error", "psnr", "ssim", "iou"}
    assert (folder / "spring_gaus" / "0" / "centres.npz").is_file()


def test_the_truth_lies_beside_the_capture_and_not_in_it(finished):
    folder = finished / "results" / PACKAGE
    assert (folder / "capture_truth.npz").is_file()
    assert {path.name for path in (folder / "capture").iterdir()} == {"capture.json", "color", "depth", "mask", "tracks.json"}


def test_a_folder_of_the_user_s_own_and_masks_that_the_user_repairs(place):
    capture = film(place / "mine" / "film", cameras=2)
    table = place / "config" / "scenarios.tsv"
    table.write_text(table.read_text() + "film\tcapture\ttoy\tfilm\tfalse\ttrue\n")
    changes = {"scenarios": ["film"], "methods": ["search_only"], "compare_with": "search_only", "data_root": str(place / "mine")}
    changes |= {"perception": PERCEPTION, "images": {"appearance": {"iterations": 20}}, "tracking": {"enabled": False}}
    result = run(place, changes)
    assert result.returncode == 0, result.stdout + result.stderr
    record = json.loads((place / "results" / "film" / "search_only" / "0" / "run.json").read_text())
    assert record["status"] == "ok"
    # No truth, no table of perception.
    assert not (place / "results" / "tables" / "perception.md").exists()

    target = "results/film/perception/1/masks.json"
    assert "Nothing to be done" in (again := run(place, changes, "--dry-run", "--", target)).stdout + again.stderr
    path = capture.path("mask", "1", 2)
    path.write_bytes(path.read_bytes())
    assert jobs(run(place, changes, "--dry-run", "--", target)) == {"segment": 1}


def test_processed_cases_with_images_beside_them_are_drawn_too(place):
    """PhysTwin's released folders: observations come from final_data.pkl, pictures from color, depth and mask."""
    capture = film(place / "mine" / "film", up="-z")
    seen = perceived(capture, place / "seen")
    case = write_raw(capture, place / "data" / "film")
    dump(case / "final_data.pkl", final_data(seen))
    table = place / "config" / "scenarios.tsv"
    table.write_text(table.read_text() + "film\tphystwin\ttoy\tfilm\tfalse\ttrue\n")
    changes = {"scenarios": ["film"], "methods": ["search_only"], "compare_with": "search_only", "data_root": str(place / "data")}
    changes |= {"perception": PERCEPTION | {"segment": {"backend": "opencv"}}, "images": {"appearance": {"iterations": 60}}}
    changes["tracking"] = {"enabled": False}
    # Tables, the report and MLflow take any run alike.
    result = run(place, changes, "--", "results/film/search_only/0/run.json")
    assert result.returncode == 0, result.stdout + result.stderr
    expected = ("capture", "segment", "observe", "search", "rollout", "appearance", "render", "score")
    assert jobs(result) == dict.fromkeys(expected, 1) | {"segment": 3}
    scores = pd.read_parquet(place / "results" / "film" / "search_only" / "0" / "scores.parquet")
    assert scores.loc[scores["metric"] == "psnr", "value"].min() > 12
    masks = json.loads((place / "results" / "film" / "perception" / "0" / "masks.json").read_text())
    assert masks["settings"]["Segmentation"]["backend"] == "given"
    # Without its images the case has no pictures, and the rest runs.
    shutil.rmtree(case / "color")
    assert "appearance" not in jobs(run(place, changes | {"results": "other"}, "--dry-run"))


def test_a_capture_that_is_not_there_is_named_before_any_job(place):
    table = place / "config" / "scenarios.tsv"
    table.write_text(table.read_text() + "film\tcapture\ttoy\tfilm\tfalse\ttrue\n")
    result = run(place, {"scenarios": ["film"], "methods": ["search_only"], "data_root": str(place)}, "--dry-run")
    assert result.returncode != 0
    assert "film" in result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
