"""The report shows methods without a search: their steps, settings, curves, times and splats."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.core.records import StageRecord
from neuspring.report.page import Options, write
from neuspring.scores.paper import Study
from tests.support import report_tree
from tests.support.report_tree import page_section as section

SYSTEMS = Study(title="Systems", reference=None, baseline="Ours", rows={"SG": "spring_gaus", "Ours": "baseline"})


def report(results: Path, **options) -> str:
    """The page of a results folder, as text."""
    return write(results, results / "report.html", Options(**options)).read_text()


def write_baseline(results: Path, scenario: str, method: str, model: str, *, trained: bool = True, splats: str = "") -> None:
    """A finished run of a baseline's model as the workflow leaves it."""
    seen = Observations.load(results / scenario / "observations.npz")
    folder = results / scenario / method / "0"
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"rollout": {"model": model}}
    records = ["rollout.json"]
    if trained:
        own = config.plain(config.Config())["baselines"].get(model, {})
        settings["train"] = {"model": model, **own, "seed": 0} | ({"anchors": 77} if model == "spring_gaus" else {})
        report_tree.write_history(folder / "history.parquet", "loss", np.exp(-np.arange(6.0)))
        StageRecord(stage="train", status="ok", settings=settings["train"]).save(folder / "train.json")
        records.insert(0, "train.json")
    images = []
    if splats:
        place = results / scenario / splats / "0"
        place.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(place / "appearance.png"), np.full((40, 60, 3), 90, np.uint8))
        StageRecord(stage="appearance", status="ok").save(place / "appearance.json")
        records.append(f"../../{splats}/0/appearance.json")
        images.append(f"../../{splats}/0/appearance.png")
    report_tree.write_run(
        results,
        seen,
        method,
        0,
        {},
        variant={"model": model, "ignore_hands": True},
        settings=settings,
        histories={"train": "history.parquet"} if trained else {},
        timings=dict.fromkeys((Path(name).stem for name in records), 60.0) | {"score": 1.0},
        peak_memory_mb={},
        artifacts={"records": records, "plots": [], "images": images},
    )
    (folder / "fit.json").unlink()
    StageRecord(stage="rollout", status="ok", settings=settings["rollout"]).save(folder / "rollout.json")
    if trained:
        report_tree.write_history(folder / "history.parquet", "loss", np.exp(-np.arange(6.0)))


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """One twin method and three baselines on one scenario, two of them with splats."""
    folder = report_tree.make(tmp_path_factory.mktemp("report") / "results", ["rope"], ["baseline"], [0], pictures=False)
    write_baseline(folder, "rope", "spring_gaus", "spring_gaus", splats="appearance-spring_gaus")
    write_baseline(folder, "rope", "gs_dynamics", "gs_dynamics", splats="appearance")
    write_baseline(folder, "rope", "static", "static", trained=False)
    return folder


@pytest.fixture(scope="module")
def page(results) -> str:
    return report(results, studies={"systems": SYSTEMS})


def test_models_are_shown(page):
    assert "rollout.model" in section(page, "details")


def test_training_curves_stand_beside_those_of_fits(page):
    text = section(page, "curves")
    assert "Fit: loss" in text and "Training of baselines: loss" in text
    assert "Training of baselines: loss, rope: spring_gaus, gs_dynamics" in page or (
        "Training of baselines: loss, rope: gs_dynamics, spring_gaus" in page
    )


def test_jobs_of_baselines_belong_to_their_methods(results, tmp_path):
    names = ("train/rope/spring_gaus/0", "predict/rope/static/0", "appearance/rope/appearance/0")
    for name in (*names, "appearance/rope/appearance-spring_gaus/0"):
        report_tree.save_job(tmp_path, name, [report_tree.attempt(0, 60)])
    text = section(report(tmp_path), "work")
    for words in ("spring_gaus 1 0", "static 1 0", "splats shared 1", "splats spring_gaus 1"):
        assert words in text
    assert text.index("train 1") < text.index("predict 1") < text.index("appearance 2")
    assert {"spring_gaus", "static"} <= set(section(report(tmp_path), "failures").split())


def test_every_picture_of_splats_is_shown_with_its_methods(page):
    text = section(page, "pictures")
    assert "Observed and drawn in frame 0, spring_gaus" in text and "Observed and drawn in frame 0, gs_dynamics" in text


def test_what_does_not_apply_is_no_run(results):
    studied = {
        "studies": {"systems": SYSTEMS},
        "scenarios": ["rope", "cable"],
        "methods": ["baseline", "spring_gaus"],
        "seeds": [0],
    }
    page = report(results, **studied, left_out={"spring_gaus": {"cable": "it needs images"}})
    assert "1 of 3 runs have not finished." in section(page, "verdict")
    assert "Left out: spring_gaus on cable: it needs images." in section(page, "details")
    assert "empty: does not apply" in section(page, "failures")
    assert "2 of 4 runs have not finished." in section(report(results, **studied), "verdict")
