"""The command line: exit status and messages."""

import errno
import json
import re

import pandas as pd
import pytest

from neuspring.cli import main as main_module
from neuspring.cli.main import _threads, main
from neuspring.core import files
from neuspring.core.artifacts import Observations
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import StageRecord
from neuspring.experiments.tracking import log as tracking
from tests.support.phystwin_case import write_case


def test_a_step_by_hand_with_yaml_settings(tmp_path, monkeypatch):
    settings = tmp_path / "small.yaml"
    settings.write_text("toy: {frames: 5}\n")
    output = tmp_path / "observations.npz"
    arguments = ["observe", "--scenario", "toy_blob_lift_smooth", "--settings", f"config/data/demo.yaml,{settings}"]
    assert main([*arguments, "--output", str(output)]) == 0
    assert Observations.load(output).scenario.frame_count == 5


TINY = {"toy": {"frames": 5}, "search": {"rollouts": 2}, "fit": {"epochs": 1}}


def observed(folder):
    """Observations of a tiny scene."""
    row = {"scenario": "tiny", "source": "toy", "category": "rope", "path": "rope/lift/smooth"}
    row |= {"self_collision": False, "ground": True}
    path = folder / "observations.npz"
    assert main(["observe", "--scenario", json.dumps(row), "--settings", json.dumps(TINY), "--output", str(path)]) == 0
    return path


def test_regions_and_fields_by_hand(tmp_path, capsys):
    """Options reach the stages."""
    common = ["--observations", str(observed(tmp_path)), "--settings", json.dumps(TINY), "--device", "cpu"]
    found, fitted = tmp_path / "search.json", tmp_path / "fit.json"
    assert main(["search", *common, "--clusters", "2", "--seed", "3", "--output", str(found)]) == 0
    fit = ["fit", *common, "--search", str(found), "--output", str(fitted), "--kind"]
    assert main([*fit, "rod"]) == 2
    assert "--kind: must be one of springs, field for this twin; received rod" in capsys.readouterr().err
    assert main([*fit, "field"]) == 0
    search = StageRecord.load(found)
    assert (search.settings["clusters"], search.settings["seed"], "object_radius.1" in search.facts) == (2, 3, True)
    assert StageRecord.load(fitted).settings["kind"] == "field"


def test_a_numerical_failure_passes_through_every_stage_and_shows_in_the_table(tmp_path):
    """No candidate can be integrated with a single substep, so the search fails numerically; no command does."""
    settings = TINY | {"simulation": {"safety": 1e-6}, "search": {"rollouts": 11}}
    common = ["--observations", str(observed(tmp_path)), "--device", "cpu"]
    seen, folder = ["--observations", str(observed(tmp_path))], tmp_path / "toy_rope_lift_smooth" / "search_only" / "0"
    found, rolled = folder / "search.json", folder / "rollout.json"
    assert main(["search", *common, "--settings", json.dumps(settings), "--output", str(found)]) == 0
    assert main(["rollout", *common, "--learned", str(found), "--output", str(rolled)]) == 0
    run = ["--method", "search_only", "--search", str(found), "--rollout", str(rolled), "--output", str(folder / "run.json")]
    assert main(["score", *seen, *run]) == 0
    runs = ["--scenarios", "toy_rope_lift_smooth", "--methods", "search_only", "--seeds", "0"]
    assert main(["tables", "--results", str(tmp_path), *runs, "--output", str(tmp_path / "tables")]) == 0
    assert "0 of 1 runs have finished" in (tmp_path / "tables" / "summary.md").read_text()
    (row,) = pd.read_csv(tmp_path / "tables" / "runs.csv").to_dict("records")
    assert row["status"] == "failed" and "none of 11 candidates could be simulated" in row["reason"]


def test_words_that_are_no_option_end_with_status_2(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["search", "--twins-per-launch", "many", "--observations", "x.npz", "--output", "y.json"])
    assert caught.value.code == 2
    assert "--twins-per-launch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["observe", "--scenario", "nothing", "--output", "x.npz"], "--scenario: must be a row of config/scenarios.tsv"),
        (["observe", "--scenario", "{", "--output", "x.npz"], "--scenario: must be JSON"),
        (["observe", "--scenario", "{}", "--output", "x.npz"], "scenario: required, but missing"),
        (["observe", "--scenario", "x", "--settings", '{"toy": {"framez": 3}}', "--output", "x.npz"], "toy.framez: unknown key"),
        (["observe", "--scenario", "x", "--settings", "no.yaml", "--output", "x.npz"], "no.yaml: this file must be readable"),
        (["search", "--observations", "no.npz", "--output", "x.json"], "no.npz: this file must be readable; received No such file"),
        (["check-data", "no-such-folder"], "no-such-folder"),
    ],
)
def test_bad_input_ends_with_status_2_and_says_why(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_check_data_tells_errors_by_its_status(tmp_path, capsys):
    case = write_case(tmp_path, "single_push_sloth_small")
    assert main(["check-data", str(case)]) == 0
    (case / "split.json").write_text(json.dumps({"frame_len": 5, "train": [0, 500], "test": [500, 900]}))
    assert main(["check-data", str(case)]) == 2
    assert "split.json" in capsys.readouterr().out


def test_sync_reports_a_damaged_record(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tracking, "init", lambda *_: {"outcome": "ready"})
    record = tmp_path / "scene" / "method" / "0" / "run.json"
    record.parent.mkdir(parents=True)
    record.write_text("{}")
    assert main(["sync", "--results", str(tmp_path)]) == 1
    assert "damaged: 1" in capsys.readouterr().out


@pytest.mark.parametrize("device", ["gpu", "cuda:x", "cuda:-1", "CUDA:0", "cuda:99"])
def test_a_device_that_is_not_there_is_an_error_not_a_fallback(device):
    with pytest.raises(InputError, match="device"):
        resolve_device(device)


@pytest.mark.parametrize(
    ("options", "together", "threads"),
    [([], 0, 1), (["--twins-per-launch", "auto"], 0, 1), (["--twins-per-launch", "12", "--threads", "3"], 12, 3)],
)
def test_a_search_knows_how_many_candidates_and_threads_it_may_take(tmp_path, monkeypatch, options, together, threads):
    asked = []

    def stop(problem, *_, **__):
        asked.append((problem.together, problem.threads))
        raise NumericalFailure("stopped")

    monkeypatch.setattr("neuspring.twin.search.search", stop)
    arguments = ["--observations", str(observed(tmp_path)), "--device", "cpu", "--output", str(tmp_path / "search.json")]
    assert main(["search", *arguments, *options]) == 0
    assert asked == [(together, threads)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--twins-per-launch", "0"], "--twins-per-launch: must be auto or an integer of at least 1; received 0"),
        (["--threads", "0"], "--threads: must be at least 1; received 0"),
    ],
)
def test_a_search_without_threads_or_twins_is_bad_input(words, message, tmp_path, capsys):
    common = ["--observations", str(observed(tmp_path)), "--device", "cpu", "--output", str(tmp_path / "y.json")]
    assert main(["search", *common, *words]) == 2
    assert message in capsys.readouterr().err


def test_libraries_take_the_threads_that_a_command_does_not_take_itself():
    """Else every thread of a search would start as many again."""
    assert _threads(["fit", "--threads", "4"]) == "4"
    assert _threads(["search", "--threads", "4"]) == "1"
    assert _threads(["fit"]) == _threads([]) == "1"


def stopped_by(monkeypatch, capsys, ends):
    """Exit status and message of a command that `ends` like this, and the cause that its job would have."""

    def run(words):
        ends()

    monkeypatch.setattr(main_module, "_run", run)
    status, text = main_module.main(["fit"]), capsys.readouterr().err
    return status, text


def test_a_full_disk_is_one_message_with_the_file_the_disk_and_how_to_go_on(monkeypatch, capsys, tmp_path):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    path = tmp_path / "twin.ply"
    status, text = stopped_by(monkeypatch, capsys, lambda: files.write_text(path, "text"))
    assert status == 1
    where = rf"neuspring: error: {re.escape(str(path))}: no space left on device: the disk at /\S* has [\d.]+ of [\d.]+ GB free\. "
    remedy = r"Free some space there, then rerun the same command to resume\.\n"
    assert re.fullmatch(where + remedy, text)


def test_ctrl_c_is_a_line_that_says_what_is_kept_and_no_cause_of_failure(monkeypatch, capsys):
    def pressed():
        raise KeyboardInterrupt

    status, text = stopped_by(monkeypatch, capsys, pressed)
    assert status == 130
    assert text == "neuspring: interrupted. Rerun the same command; searches and fits resume from their checkpoints.\n"


def test_other_errors_of_the_system_are_not_taken_for_a_full_disk(monkeypatch, capsys):
    def missing():
        raise FileNotFoundError(errno.ENOENT, "no such file")

    with pytest.raises(FileNotFoundError):
        stopped_by(monkeypatch, capsys, missing)
