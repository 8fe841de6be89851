"""The released archives and results, on a small case in their layout. The real hub is never asked."""

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.released import commands, fetch
from neuspring.extensions.released.files import Released, read_checkpoint, read_parameters
from neuspring.extensions.released.verify import verify_released
from neuspring.intake.phystwin import released_cases
from neuspring.physics.topology import uniform_topology
from neuspring.scores.paper import Printed
from tests.support.phystwin_case import dump, stored, write_case

NAME = "single_lift_rope"
ROW = released_cases()[NAME]
PARAMETERS = {
    "object_radius": np.float64(0.025),
    "object_max_neighbours": 10,
    "controller_radius": np.float64(0.06),
    "controller_max_neighbours": 10,
    "drag_damping": np.float32(3.5),
}


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    """A case with results: a prediction that moves rigidly with the observed points, for reading only."""
    root = tmp_path_factory.mktemp("released")
    folder = write_case(root, NAME, frames=10, points=40)
    data, case = stored(folder), Released(root, NAME)
    rest = np.concatenate([data["object_points"][0], data["surface_points"], data["interior_points"]]).astype(np.float32)
    hands = data["controller_points"].astype(np.float32)
    dump(case.prediction, rest + (hands[:, :1] - hands[0, 0]))
    dump(case.parameters, PARAMETERS)
    topology = uniform_topology(rest, hands[0], 0.025, 10, 0.06, 10)
    checkpoint = case.checkpoint.with_name(f"best_{ROW['best_epoch']}.pth")
    checkpoint.parent.mkdir()
    stored_springs = {"spring_Y": torch.full((len(topology.springs),), 3e4), "num_object_springs": topology.object_spring_count}
    torch.save(stored_springs, checkpoint)
    return root


@pytest.fixture
def case(released, tmp_path):
    """A copy that may be altered."""
    shutil.copytree(released, tmp_path / "root")
    return Released(tmp_path / "root", NAME)


def outcomes(case, tmp_path):
    table = verify_released(
        case.root, tmp_path / "out", published={(NAME, "future", "track_error"): Printed(text="", value=0.0, slack=1e-6)}
    )
    return {f"{row['task']} {row['quantity']}".replace("nan ", ""): row["outcome"] for row in table.to_dict("records")}


def shift_future(case):
    positions = load_pickle(case.prediction)
    positions[7:] += np.float32(0.002)
    dump(case.prediction, positions)


def move_first_frame(case):
    positions = load_pickle(case.prediction)
    positions[0, 3] += np.float32(1e-6)
    dump(case.prediction, positions)


def drop_spring(case):
    checkpoint = torch.load(case.checkpoint, weights_only=True)
    torch.save(checkpoint | {"spring_Y": checkpoint["spring_Y"][:-1]}, case.checkpoint)


def narrow_radius(case):
    dump(case.parameters, PARAMETERS | {"object_radius": 0.02})


def cut_prediction(case):
    dump(case.prediction, load_pickle(case.prediction)[:, :5])


SPRINGS = {"springs of the checkpoint", "object springs of the checkpoint"}


@pytest.mark.parametrize(
    ("alter", "failed"),
    [
        (lambda case: None, set()),
        (shift_future, {"future track_error"}),
        (move_first_frame, {"other nodes in frame 0"}),
        (drop_spring, {"springs of the checkpoint"}),
        (narrow_radius, SPRINGS),
        (cut_prediction, {"scores"}),
        (lambda case: case.checkpoint.write_bytes(b"PK damaged"), {"checkpoint"}),
        (lambda case: (case.folder / "split.json").unlink(), {"processed data"}),
    ],
    ids=["conforming", "future", "frame 0", "spring", "radius", "shape", "damaged", "no split"],
)
def test_every_alteration_fails_its_comparison(case, tmp_path, alter, failed):
    alter(case)
    found = {name for name, outcome in outcomes(case, tmp_path).items() if outcome == "failed"}
    # The small case has neither the sizes nor the springs of the released one.
    sizes = {"frames", "train_end", "object_points", "nodes"}
    assert found - sizes - {"springs"} == failed
    assert sizes <= found or failed == {"processed data"}


def test_a_missing_file_skips_its_comparison_and_no_published_number_is_needed(case, tmp_path):
    case.parameters.unlink()
    found = outcomes(case, tmp_path)
    assert found["checkpoint"] == "skipped"
    assert found["reconstruction chamfer"] == "measured"
    assert found["future track_error"] == "passed"


def test_means_over_all_cases_are_compared_with_the_published_ones(released, tmp_path, monkeypatch):
    monkeypatch.setattr("neuspring.extensions.released.verify.released_cases", lambda: {NAME: ROW})
    table = verify_released(released, tmp_path)
    means = table[table["scenario"] == "MEAN22_REEVAL"].set_index(["task", "quantity"])
    assert len(means) == 4
    assert means.loc[("future", "chamfer"), "published"] == pytest.approx(0.011579, abs=1e-6)


def test_the_command_prints_every_row_and_fails_with_one(released, tmp_path, capsys):
    assert commands.verify_released(released, tmp_path) == 1
    assert "object springs of the checkpoint" in capsys.readouterr().out
    assert (tmp_path / "verify.csv").is_file()


def test_pickles_and_checkpoints_run_nothing(case, tmp_path):
    class Harmful:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    torch.save({"spring_Y": Harmful(), "num_object_springs": 1}, case.checkpoint)
    dump(case.parameters, {"object_radius": Harmful()})
    for reader, path in ((read_checkpoint, case.checkpoint), (read_parameters, case.parameters)):
        with pytest.raises(InputError, match=path.name):
            reader(path)
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def hub(released, tmp_path, monkeypatch):
    """A folder of archives in place of the hub, with members that no part has."""
    folder = tmp_path / "hub"
    folder.mkdir()
    for tree, name in fetch.TREES.items():
        with zipfile.ZipFile(folder / name, "w") as archive:
            for path in sorted((released / tree).rglob("*.*")):
                archive.write(path, path.relative_to(released))
            for stray in ("depth/0/0.npy", "color/0.mp4", "../../../outside.pkl"):
                archive.writestr(f"{tree}/{NAME}/{stray}", b"0" * 100)
            archive.writestr(f"{tree}/another_case/inference.pkl", b"")

    class Hub:
        def __init__(self, token):
            assert token is False

        def open(self, path, **_):
            assert path.startswith("datasets/Jianghanxiao/PhysTwin@main/")
            return (folder / Path(path).name).open("rb")

    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.setattr(fetch, "HfFileSystem", Hub)
    return folder


def test_parts_arrive_where_the_reader_looks_and_complete_files_stay(hub, released, tmp_path, capsys):
    target = tmp_path / "data_root"
    fetch.fetch(target, [NAME], ["data", "images", "results"], dry_run=True)
    assert not target.exists()
    fetch.fetch(target, [NAME], ["data", "images", "results"])
    files = {path.relative_to(target).as_posix(): path.read_bytes() for path in target.rglob("*.*")}
    expected = {path.relative_to(released).as_posix(): path.read_bytes() for path in released.rglob("*.*")}
    assert files == expected | {f"data/different_types/{NAME}/depth/0/0.npy": b"0" * 100}
    changed = Released(target, NAME).prediction
    changed.write_bytes(changed.read_bytes()[:-1])
    capsys.readouterr()
    fetch.fetch(target, [NAME], ["results"])
    assert "experiments.zip: 2 files; 1 are missing" in capsys.readouterr().out
    assert changed.read_bytes() == expected[changed.relative_to(target).as_posix()]


def test_the_command_checks_what_it_fetched(hub, tmp_path):
    # Sizes and springs are not those of the released case; the layout is.
    assert commands.fetch("phystwin", (NAME,), data_root=tmp_path / "data_root", parts=("data",)) == 0


def damage(hub):
    path = hub / "experiments.zip"
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("change", "scenarios", "message"),
    [
        (damage, [NAME], "BadZipFile: Bad CRC-32"),
        (lambda hub: (hub / "experiments.zip").write_bytes(b"no archive"), [NAME], "BadZipFile"),
        (lambda hub: (hub / "experiments.zip").unlink(), [NAME], "FileNotFoundError.*resume"),
        (lambda hub: None, ["rope_double_hand"], "must contain files"),
        (lambda hub: None, ["nothing"], "SCENARIO: must be among"),
    ],
)
def test_what_cannot_be_fetched_is_named(hub, tmp_path, change, scenarios, message):
    change(hub)
    with pytest.raises(InputError, match=message):
        fetch.fetch(tmp_path / "data_root", scenarios, ["results"])
    assert not list(tmp_path.joinpath("data_root").rglob("*.part"))
    assert not list(tmp_path.joinpath("data_root").rglob("inference.pkl"))
