"""verify-released on small stand-ins of the released results: each check passes on them, and fails when one thing is altered."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.extensions.released.checks import AS_RELEASED, MEAN, Comparison, Published, frame_scores, of_means
from neuspring.extensions.released.files import Released, depth_image, gated_lift, read_checkpoint, read_parameters, visible_pixels
from neuspring.extensions.released.run import RELEASED_CHECKS, Report, read_observations, verify_released
from neuspring.intake.phystwin import released_cases
from neuspring.intake.phystwin_raw import read_calibration
from neuspring.scores.lpips import CHANNELS, WINDOWS, Lpips
from neuspring.scores.metrics import METRICS
from tests.extensions.released.released_case import (
    DASHPOT,
    DRAG,
    FRAMES,
    HEIGHT,
    TRAIN_END,
    WIDTH,
    drawn,
    positions_of,
    published_of,
    write_cameras,
    write_checkpoint,
    write_parameters,
    write_png,
    write_prediction,
    write_released,
)
from tests.support.phystwin_case import dump, edit, stored

NAME = "single_lift_thing"


@pytest.fixture(scope="module")
def conforming(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A conforming stand-in, for reading only."""
    root = tmp_path_factory.mktemp("released")
    write_released(root, NAME)
    return root


@pytest.fixture
def case(conforming: Path, tmp_path: Path) -> Released:
    """A copy that may be altered."""
    shutil.copytree(conforming, tmp_path / "root")
    return Released(root=tmp_path / "root", name=NAME)


@pytest.fixture(scope="module")
def published(conforming: Path) -> Published:
    """What others would have published about the stand-in, computed with loops."""
    return published_of(Released(root=conforming, name=NAME))


def verify(case: Released, published: Published, *checks: int) -> Report:
    out, chosen = case.root.parent / "out", checks or tuple(RELEASED_CHECKS)
    return verify_released(case.root, out, checks=chosen, device="cpu", published=published)


def of(report: Report, outcome: str) -> set[int]:
    return {finding.check for finding in report.findings if finding.outcome == outcome}


def test_a_conforming_case_passes_every_check(conforming, published, tmp_path):
    report = verify_released(conforming, tmp_path, device="cpu", published=published)
    assert report.status == 0
    assert of(report, "passed") == {1, 2, 3, 4, 5, 6}
    assert of(report, "failed") == set()
    # Without weights LPIPS is named as not computed; nothing else is left out.
    assert [f.quantity for f in report.findings if f.outcome == "skipped"] == ["lpips"]
    means = {(f.task, f.quantity) for f in report.findings if f.scenario == MEAN and f.outcome == "passed"}
    metrics = ("chamfer", "track_error", "psnr", "iou")
    assert means == {(task, metric) for task in ("reconstruction", "future") for metric in metrics}


def drop_spring(case: Released) -> None:
    checkpoint = torch.load(case.checkpoint, weights_only=True)
    torch.save(checkpoint | {"spring_Y": checkpoint["spring_Y"][:-1]}, case.checkpoint)


def count_other_object_springs(case: Released) -> None:
    checkpoint = torch.load(case.checkpoint, weights_only=True)
    torch.save(checkpoint | {"num_object_springs": checkpoint["num_object_springs"] - 1}, case.checkpoint)


def narrow_radius(case: Released) -> None:
    write_parameters(case, object_radius=np.float64(0.02))


def shift_future(case: Released) -> None:
    positions = positions_of(case)
    positions[TRAIN_END:] += np.float32(0.002)
    dump(case.prediction, positions)


def spoil_principal_point(case: Released) -> None:
    write_cameras(case, shift=2.5)


def swap_rows_and_columns(case: Released) -> None:
    path = case.pixel_tracks("0")
    with np.load(path) as stored_tracks:
        tracks, visibility = stored_tracks["tracks"], stored_tracks["visibility"]
    for camera in "012":
        np.savez(case.pixel_tracks(camera), tracks=tracks[..., ::-1], visibility=visibility)


def forget_humans(case: Released) -> None:
    for path in case.human_masks.glob("*.png"):
        write_png(path, np.zeros((HEIGHT, WIDTH), np.uint8))


def crop_masks(case: Released) -> None:
    for path in case.object_masks.glob("*.png"):
        write_png(path, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) * (np.arange(WIDTH) < WIDTH // 2).astype(np.uint8))


def keep_own_intrinsics(case: Released) -> None:
    path = case.folder / "metadata.json"
    path.write_text(path.read_text().replace("35.5", "37.0"))


def predict_with_float_damping(case: Released) -> None:
    dump(case.prediction, positions_of(float_damped(case)))


def float_damped(case: Released) -> Released:
    """The case, predicted again with the dampings as searched."""
    data = stored(case.folder)
    nodes = positions_of(case)[0]
    write_prediction(case, write_checkpoint(case, nodes, data["controller_points"][0].astype(np.float32), False), DRAG, DASHPOT)
    return case


def move_first_frame(case: Released) -> None:
    positions = positions_of(case)
    positions[0, 3] += np.float32(1e-6)
    dump(case.prediction, positions)


def soften(case: Released) -> None:
    checkpoint = torch.load(case.checkpoint, weights_only=True)
    torch.save(checkpoint | {"spring_Y": 0.98 * checkpoint["spring_Y"]}, case.checkpoint)


ALTERED = [
    (1, move_first_frame),
    (2, drop_spring),
    (2, count_other_object_springs),
    (2, narrow_radius),
    (3, shift_future),
    (4, spoil_principal_point),
    (4, swap_rows_and_columns),
    (5, shift_future),
    (5, forget_humans),
    (5, crop_masks),
    (5, keep_own_intrinsics),
    (6, shift_future),
    (6, predict_with_float_damping),
    (6, soften),
    (6, drop_spring),
]


@pytest.mark.parametrize(("check", "alter"), ALTERED, ids=[f"{check}-{alter.__name__}" for check, alter in ALTERED])
def test_what_is_altered_fails_its_check(case: Released, published: Published, check: int, alter: Callable[[Released], None]):
    alter(case)
    report = verify(case, published, check)
    assert of(report, "failed") == {check}
    assert report.status == 1
    assert f"{NAME} ({check})" in report.text


def test_only_the_frames_that_were_altered_fail(case, published):
    shift_future(case)
    report = verify(case, published, 3)
    assert {f.task for f in report.findings if f.outcome == "failed"} == {"future"}
    assert {f.task for f in report.findings if f.outcome == "passed"} == {"reconstruction"}


def test_both_dampings_are_reported_and_the_wrong_one_is_far(conforming, published, tmp_path):
    report = verify_released(conforming, tmp_path, checks=[6], device="cpu", published=published)
    by_quantity = {f.quantity: f for f in report.findings}
    truncated, floats = (by_quantity[f"mean distance of nodes, {label}"] for label in ("dampings truncated", "float dampings"))
    assert truncated.ours < truncated.tolerance < 0.2 * floats.ours
    frames = pd.read_csv(tmp_path / "verify_frames.csv")
    assert frames.groupby("quantity")["frame"].max().eq(FRAMES - 1).all()
    assert frames["quantity"].nunique() == 5


def test_whole_dampings_are_said_to_make_no_difference(case, published):
    write_parameters(case, drag_damping=np.float64(3.0), dashpot_damping=np.float64(40.0))
    assert "the same replay" in verify(case, published, 6).text


@pytest.mark.parametrize("self_collision", [True, False])
def test_only_cloth_collides_with_itself(tmp_path, self_collision):
    """A case named a cloth is replayed with collisions between nodes, so a prediction without them is not met."""
    case = write_released(tmp_path, "tiny_cloth", self_collision=self_collision)
    report = verify_released(case.root, tmp_path / "out", checks=[6], device="cpu")
    assert of(report, "failed") == (set() if self_collision else {6})


@pytest.mark.parametrize(("mirrored", "convention"), [(True, "W - c_x"), (False, "c_x")])
def test_the_data_say_which_principal_point_they_were_lifted_with(tmp_path, mirrored, convention):
    case = write_released(tmp_path, mirrored=mirrored)
    report = verify_released(case.root, tmp_path / "out", checks=[4], device="cpu")
    (judged,) = (f for f in report.findings if f.outcome == "passed")
    (other,) = (f for f in report.findings if f.outcome == "measured")
    assert judged.note == f"the data follow {convention}"
    assert judged.ours < 1e-6 < 1e-3 < other.ours
    assert f"- the data follow {convention}: 1 of 1 scenarios" in report.text


def test_conventions_that_coincide_cannot_be_told_apart(case, published):
    path = case.folder / "metadata.json"
    text = path.read_text()
    for center in ("37.0", "35.5", "30.5"):
        text = text.replace(center, "32.0")
    path.write_text(text)
    lifted = [
        gated_lift(c, visible_pixels(case.pixel_tracks(c.name)), depth_image(case.first_depth(c.name), c))
        for c in read_calibration(case.folder)[1]
    ]
    data = stored(case.folder)
    data["object_points"][0] = np.unique(np.concatenate(lifted), axis=0)[: data["object_points"].shape[1]]
    edit(case.folder, object_points=data["object_points"])
    report = verify(case, published, 4)
    assert of(report, "skipped") == {4}
    assert "give the same points" in report.text


MISSING = {
    1: [f"experiments/{NAME}/inference.pkl"],
    2: ["experiments_optimization", f"experiments/{NAME}/train"],
    3: [f"experiments/{NAME}/inference.pkl"],
    4: [
        f"data/different_types/{NAME}/cotracker",
        f"data/different_types/{NAME}/depth",
        f"data/different_types/{NAME}/calibrate.pkl",
    ],
    5: ["gaussian_output", "data/render_eval_data", "data/different_types_human_mask", f"experiments/{NAME}/inference.pkl"],
    6: ["experiments_optimization", f"experiments/{NAME}/train", f"experiments/{NAME}/inference.pkl"],
}


@pytest.mark.parametrize(("check", "path"), [(check, path) for check, paths in MISSING.items() for path in paths])
def test_a_check_without_its_files_is_skipped_and_says_which(case, published, check, path):
    gone = case.root / path
    shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
    report = verify(case, published, check)
    assert of(report, "skipped") == {check}
    assert report.status == 2
    assert "Nothing could be compared" in report.text
    assert path.replace(NAME, "<case>").rpartition("/")[2] in report.text.partition("## Skipped")[2]


def test_without_annotated_tracks_the_rest_is_still_scored(case, published):
    (case.folder / "gt_track_3d.pkl").unlink()
    report = verify(case, published, 3)
    assert {f.quantity for f in report.findings if f.outcome == "skipped"} == {"track_error"}
    assert {f.quantity for f in report.findings if f.outcome == "passed"} == {"chamfer"}


DAMAGE: list[tuple[str, set[int]]] = [
    (f"experiments/{NAME}/inference.pkl", {1, 3, 5, 6}),
    (f"experiments_optimization/{NAME}/optimal_params.pkl", {2, 6}),
    (f"experiments/{NAME}/train/best_199.pth", {2, 6}),
    (f"data/different_types/{NAME}/final_data.pkl", {1, 2, 3, 4, 5, 6}),
    (f"data/different_types/{NAME}/cotracker/1.npz", {4}),
    (f"data/different_types/{NAME}/depth/2/0.npy", {4}),
    (f"data/render_eval_data/{NAME}/mask/0/3.png", {5}),
]


@pytest.mark.parametrize(("path", "checks"), DAMAGE, ids=[path.rpartition("/")[2] for path, _ in DAMAGE])
def test_a_damaged_file_fails_its_checks_and_no_other_scenario(case, published, path, checks):
    for folder in [p for p in case.root.rglob(NAME) if p.is_dir()]:
        shutil.copytree(folder, folder.with_name("a_second_thing"))
    file = case.root / path
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    # Replays take longest; one is enough to see that they go on.
    asked = checks if checks != {1, 2, 3, 4, 5, 6} else {1, 2, 3, 4}
    report = verify(case, published, *asked)
    assert {(f.scenario, f.check) for f in report.findings if f.outcome == "failed"} == {(NAME, check) for check in asked}
    assert {f.check for f in report.findings if f.scenario == "a_second_thing" and f.ours is not None} == asked
    assert Path(path).name in report.text


def test_pickles_and_checkpoints_run_nothing(case, tmp_path):
    class Harmful:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    torch.save({"spring_Y": Harmful(), "num_object_springs": 1}, case.checkpoint)
    dump(case.parameters, {"global_spring_Y": Harmful()})
    for reader, path in ((read_checkpoint, case.checkpoint), (read_parameters, case.parameters)):
        with pytest.raises(InputError, match=path.name):
            reader(path)
    assert not (tmp_path / "ran").exists()


def test_of_several_checkpoints_the_last_counts_and_of_several_splats_none(case):
    shutil.copy(case.checkpoint, case.checkpoint.with_name("best_20.pth"))
    assert case.checkpoint.name == "best_199.pth"
    folder = case.splats.parents[2]
    shutil.copytree(folder, folder.with_name("another_training"))
    with pytest.raises(InputError, match="another_training"):
        _ = case.splats


def test_lpips_is_taken_as_released(case):
    """Random weights: inputs stay in [0, 1]; what the picture shows is that of the evaluation."""
    generator = torch.Generator().manual_seed(0)
    kernels = [
        torch.randn((after, before, size, size), generator=generator) * 0.05
        for before, after, size in zip(CHANNELS[:-1], CHANNELS[1:], WINDOWS, strict=True)
    ]
    heads = [torch.rand((1, channels, 1, 1), generator=generator) for channels in CHANNELS[1:]]
    metric = Lpips(kernels, [torch.zeros(channels) for channels in CHANNELS[1:]], heads)
    table = frame_scores(case, read_observations(case), metric, "cpu")
    score = table[(table["metric"] == "lpips") & (table["frame"] == 2)]["value"].item()
    rgba = drawn(case)[2]
    observed = cv2.imread(str(case.colors / "2.png"))[..., ::-1]
    mask, human = (cv2.imread(str(f / "2.png"), cv2.IMREAD_GRAYSCALE) / 255 for f in (case.object_masks, case.human_masks))
    pair = [
        torch.tensor(p * (1 - human)[..., None] / 255).permute(2, 0, 1).float() for p in (observed * mask[..., None], rgba[..., :3])
    ]
    assert score == pytest.approx(float(metric(*pair, released_range=True)), rel=0.01)
    assert score != pytest.approx(float(metric(*pair)), rel=0.05)


@pytest.mark.parametrize("changed", [{"released_quirks": AS_RELEASED.released_quirks[1:]}, {"corner_pixels": False}], ids=str)
def test_an_error_in_drawing_exceeds_the_tolerance(conforming, changed):
    case = Released(root=conforming, name=NAME)
    wrong = replace(AS_RELEASED, **changed)
    first, second = (frame_scores(case, read_observations(case), "none", "cpu", images) for images in (AS_RELEASED, wrong))
    for metric, values in first.groupby("metric")["value"]:
        other = second.loc[second["metric"] == metric, "value"]
        assert abs(values.mean() - other.mean()) > 4 * METRICS[metric].tolerance, metric


def test_a_released_case_is_held_against_the_known_number_of_springs(tmp_path):
    write_released(tmp_path, "single_lift_rope")
    report = verify_released(tmp_path, tmp_path / "out", checks=[2], device="cpu")
    failed = [f for f in report.findings if f.outcome == "failed"]
    assert [f.published for f in failed] == [int(released_cases()["single_lift_rope"]["springs"])]


def test_the_published_table_ships_and_agrees_with_itself():
    published = Published.load()
    assert published.scenarios == frozenset(released_cases())
    for metric, mean in {"chamfer": 0.011579, "track_error": 0.022019}.items():
        values = [published.scores[name, "future", metric].value for name in published.scenarios]
        assert np.mean(values) == pytest.approx(mean, abs=1e-6)
        first, paper = published.means("future", metric)
        assert first.value == pytest.approx(mean, abs=1e-6)
        assert abs(first.value - paper.value) <= paper.slack
    for metric, value in {"psnr": 28.2139, "ssim": 0.9449, "lpips": 0.0336, "iou": 0.8438}.items():
        assert published.means("reconstruction", metric)[0].value == pytest.approx(value, abs=5e-5)


def test_means_over_some_scenarios_are_not_held_against_those_over_all(case, published):
    more = replace(published, scenarios=frozenset({NAME, "another"}))
    means = [f for f in verify(case, more, 3).findings if f.scenario == MEAN]
    assert {f.outcome for f in means} == {"measured"}
    assert all("over 2" in f.note for f in means)


def test_means_weigh_scenarios_for_distances_and_frames_for_pictures(published):
    findings = [
        Comparison(check=check, scenario=name, quantity=metric, task="future", ours=value, frames=frames)
        for name, value, frames in (("a", 1.0, 10), ("b", 4.0, 20))
        for check, metric in ((3, "chamfer"), (5, "psnr"))
    ]
    assert {f.quantity: f.ours for f in of_means(findings, published)} == {"chamfer": 2.5, "psnr": 3.0}


def test_the_report_is_written_as_table_and_text(conforming, published, tmp_path):
    report = verify_released(conforming, tmp_path / "out", checks=[2, 3], device="cpu", published=published)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["verify.csv", "verify.md", "verify_frames.csv"]
    assert (tmp_path / "out" / "verify.md").read_text() == report.text
    table = pd.read_csv(tmp_path / "out" / "verify.csv")
    assert len(table) == len(report.findings)
    compared = table[table["outcome"] == "passed"]
    assert np.allclose(compared["difference"], compared["ours"] - compared["published"])
    assert report.text.rstrip().endswith("10 passed, 0 failed, 0 measured, 0 skipped.")


@pytest.mark.parametrize(
    ("options", "named"), [({"scenarios": ["nothing"]}, NAME), ({"checks": [7]}, "--checks"), ({"device": "gpu"}, "device")]
)
def test_unknown_scenarios_checks_and_devices_are_refused(conforming, tmp_path, options, named):
    with pytest.raises(InputError, match=named):
        verify_released(conforming, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
