"""Two commits' runs: paired like with like, and what else differs is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from neuspring.config import Tracking
from neuspring.core.errors import InputError
from neuspring.experiments.tracking import compare
from neuspring.experiments.tracking import log as tracking
from neuspring.experiments.tracking.store import LoggedRun
from tests.support.stores import write_run

OLD, NEW = "1111111aaaaaaaaaaaaa", "2222222bbbbbbbbbbbbb"


def run(commit: str, error: float, scenario: str = "rope", seed: int = 0, method: str = "ours", **changes: Any) -> LoggedRun:
    values = {
        "run_key": f"{commit}{scenario}{method}{seed}",
        "scenario": scenario,
        "category": "toy",
        "method": method,
        "seed": seed,
        "status": "ok",
        "reason": "",
        "device": "cpu",
        "data_digest": "d1",
        "commits": {commit: 1},
        "params": {"fit.epochs": "10", "fit.result.best_loss": str(error)},
        "metrics": {"future.chamfer": error, "fit.loss": 1.0, "seconds.fit": 10.0, "system/fit.memory_mb": 5.0},
    }
    return LoggedRun(**values | changes)


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> list[LoggedRun]:
    """What MLflow holds, for `compare.compare`."""
    runs: list[LoggedRun] = []
    monkeypatch.setattr(compare, "logged_runs", lambda results, settings: runs)
    return runs


def compared(runs: list[LoggedRun], first: str = OLD, second: str = NEW) -> tuple[pd.DataFrame, str]:
    comparison = compare.pair(runs, first, second)
    return comparison.differences, compare.to_markdown(comparison)


def test_scores_are_paired_by_scenario_method_and_seed() -> None:
    runs = [run(OLD, 0.010 * (1 + i), f"s{i}", seed) for i in range(3) for seed in range(2)]
    runs += [run(NEW, 0.010 * (1 + i) - 0.001, f"s{i}", seed) for i in range(3) for seed in range(2)]
    runs += [run(OLD, 0.5, "s0", method="other")]
    differences, text = compared(runs)
    assert len(differences) == 1, "neither histories nor system metrics are scores, and equal times are one measurement"
    row = differences.iloc[0]
    assert (row["method"], row["task"], row["metric"], row["unit"]) == ("ours", "future", "chamfer", "m")
    assert (row["first"], row["second"], row["pairs"], row["scenarios"]) == (OLD, NEW, 6, 3)
    assert row["mean_first"] == pytest.approx(0.020) and row["mean_second"] == pytest.approx(0.019)
    assert row[["difference", "low", "high"]].tolist() == pytest.approx([-0.001] * 3)
    assert text.startswith("# 2222222bbbbb minus 1111111aaaaa\n\n6 pairs of the same scenario, method and seed.")
    (line,) = [line for line in text.splitlines() if line.startswith("| ours")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells == ["ours", "future", "chamfer, mm", "20.00", "19.00", "-1.00 [-1.00, -1.00]", "0.938", "6"]
    assert "## Only in 1111111aaaaa\n\n- s0 / other / seed 0\n" in text
    assert "Only in 2222222bbbbb" not in text


def test_the_newest_run_of_a_commit_counts() -> None:
    runs = [run(OLD, 0.01), run(NEW, 0.03, commits={NEW: 5}), run(NEW, 0.02, commits={NEW: 7}), run(NEW, 0.04, commits={NEW: 6})]
    differences, _ = compared(runs)
    assert differences["mean_second"].tolist() == [0.02]


def test_results_that_both_commits_made_alike_are_one_run_of_both() -> None:
    both = run(OLD, 0.01, "cloth", commits={OLD: 1, NEW: 2})
    differences, text = compared([run(OLD, 0.01), run(NEW, 0.02), both])
    assert differences["difference"].tolist() == [pytest.approx(0.005)]
    assert "2 pairs of the same scenario, method and seed, of which 1 with the same results, bit for bit." in text


def test_failed_runs_are_listed_and_never_averaged() -> None:
    runs = [run(OLD, 0.01), run(NEW, 0.9, status="failed", reason="diverged at frame 3")]
    differences, text = compared(runs)
    assert not len(differences) and list(differences.columns) == list(compare.COLUMNS)
    assert "No pair succeeded in both" in text
    assert "- rope / ours / seed 0: 1111111aaaaa ok, 2222222bbbbb failed (diverged at frame 3)" in text


def test_what_is_not_code_is_pointed_out() -> None:
    other = {
        "data_digest": "d2",
        "device": "cuda:0",
        "params": {"fit.epochs": "20", "fit.rate": "0.1", "fit.result.best_loss": "1"},
    }
    _, text = compared([run(OLD, 0.01), run(NEW, 0.02, **other), run(OLD, 0.01, "cloth"), run(NEW, 0.02, "cloth")])
    assert "**The data differ** (rope)" in text and "**The devices differ** (cpu and cuda:0: 1 pairs)" in text
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| fit.")]
    assert rows == [["fit.epochs", "10", "20", "ours", "1"], ["fit.rate", "–", "0.1", "ours", "1"]]
    _, text = compared([run(OLD, 0.01), run(NEW, 0.02)])
    assert "differ**" not in text and text.endswith("## Changed parameters\n\nNone.\n")


def test_times_of_stages_that_ran_again_are_compared() -> None:
    timed = {"future.chamfer": 0.01, "seconds.fit": 10.0, "seconds.search": 3.0}
    differences, text = compared([run(OLD, 0.01, metrics=timed), run(NEW, 0.01, metrics=timed | {"seconds.fit": 5.0})])
    row = differences[differences["task"] == "seconds"].iloc[0]
    assert (row["metric"], row["unit"], row["difference"], row["ratio"]) == ("fit", "s", -5.0, pytest.approx(0.5))
    assert "fit, s" in text and "search, s" not in text


def test_commits_are_found_by_their_beginnings_and_changed_copies_are_others(logged: list[LoggedRun]) -> None:
    logged += [run(OLD, 0.01), run(f"{OLD}-dirty", 0.02), run(NEW, 0.03)]
    assert "minus 1111111aaaaa\n" in compare.compare(Path(), Tracking(), "1111", "222")
    assert "# 1111111aaaaa-dirty minus 1111111aaaaa\n" in compare.compare(Path(), Tracking(), OLD, "111-dirty")
    with pytest.raises(InputError, match="two different ones"):
        compare.compare(Path(), Tracking(), "111", OLD)


def test_a_commit_without_runs_is_an_error_that_lists_the_known_ones(logged: list[LoggedRun]) -> None:
    logged += [run(OLD, 0.01, commits={OLD: 1}), run(NEW, 0.01, commits={NEW: 2}), run(NEW, 0.01, seed=1, commits={NEW: 3})]
    with pytest.raises(InputError, match=rf"commit '333'.*Known, newest first: {NEW} \(2 runs\), {OLD} \(1 run\)"):
        compare.compare(Path(), Tracking(), "333", "222")
    for name in ("111-dirty", "-dirty", ""):
        with pytest.raises(InputError, match="must have complete runs"):
            compare.compare(Path(), Tracking(), name, "222")
    logged.append(run("2222222c", 0.01))
    with pytest.raises(InputError, match="one commit only"):
        compare.compare(Path(), Tracking(), "111", "2222")


def test_commits_are_compared_from_the_index_alone(tracked: Path, tmp_path: Path) -> None:
    results, settings = tracked, Tracking()
    for empty in (tmp_path / "none", results):
        with pytest.raises(InputError, match="neuspring sync"):
            compare.compare(empty, settings, OLD, NEW)
    assert not (tmp_path / "none").exists()

    # The first run's results change; the second's are the same again, so that MLflow keeps one run.
    for i, commit in enumerate((OLD, NEW)):
        ended = f"2026-11-21T1{i + 1}:00:00+00:00"
        write_run(results, "rope", commit=commit, ended=ended, run_key=f"{i}" * 64, timings={"fit": 8.0 + i})
        write_run(results, "cloth", commit=commit, ended=ended)
        assert set(tracking.sync(results, settings)) <= {"logged", "already logged"}
    for path in results.glob("*/ours"):
        path.rename(path.with_name("gone"))
    text = compare.compare(results, settings, "111", "222", tmp_path / "differences.csv")
    assert "2 pairs of the same scenario, method and seed, of which 1 with the same results, bit for bit." in text
    table = pd.read_csv(tmp_path / "differences.csv")
    assert list(table.columns) == list(compare.COLUMNS)
    assert set(zip(table["task"], table["metric"], table["pairs"], strict=True)) == {
        ("future", "track_error", 2),
        ("future", "chamfer", 2),
        ("seconds", "fit", 1),
    }
    assert table.loc[table["task"] == "seconds", "difference"].tolist() == [1.0]


def test_a_store_that_does_not_answer_is_named(tmp_path: Path) -> None:
    away = Tracking(uri="postgresql://secret@127.0.0.1:9/mlflow")
    with pytest.raises(InputError, match="MLflow must answer") as caught:
        compare.compare(tmp_path, away, OLD, NEW)
    assert "secret" not in str(caught.value)
