"""Fits that share launches leave what each would leave alone; what goes wrong with one is its own."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring import config
from neuspring.config.settings import read_settings
from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.stages.fit import fit
from neuspring.stages.fits import fits
from neuspring.stages.observe import observe
from neuspring.stages.search import search
from neuspring.stages.together import MemberRow
from neuspring.twin import fit as twin_fit
from tests.support import small

SETTINGS = config.Config(
    search=config.Search(rollouts=11),
    fit=config.Fit(epochs=3, field=config.SpringFieldSettings(channels=4, hidden=16, bands=2)),
    toy=config.Toy(frames=8),
    device="cpu",
)
ROWS = {"springs": SETTINGS.fit, "field": SETTINGS.fit, "ten": replace(SETTINGS.fit, horizon=3)}


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations, and the searches of two seeds."""
    folder = tmp_path_factory.mktemp("started")
    observe(scenario=small.row(), settings=SETTINGS, output=folder / "observations.npz")
    for seed in (0, 1):
        search(
            observations=folder / "observations.npz",
            settings=SETTINGS,
            clusters=1,
            seed=seed,
            device="cpu",
            output=folder / f"search-{seed}" / "search.json",
        )
    return folder


def text(name: str) -> str:
    return json.dumps({"fit": config.plain(ROWS[name])})


def rows_of(started: Path, folder: Path) -> list[MemberRow]:
    """Three rows of the method table, two seeds each; the last has another horizon."""
    return [
        MemberRow(
            options={"kind": "field" if name == "field" else "springs"},
            settings=text(name),
            jobs={
                str(folder / name / str(k) / "fit.json"): inputs(started, started / f"search-{k}" / "search.json") for k in (0, 1)
            },
        )
        for name in ROWS
    ]


def inputs(started: Path, found: Path) -> dict[str, str]:
    return {"observations": str(started / "observations.npz"), "search": str(found)}


def together(rows: list[MemberRow] | str, output: Path, **options: object) -> dict:
    """The facts of fits that share launches."""
    given = rows if isinstance(rows, str) else json.dumps([asdict(row) for row in rows])
    fits(rows=given, device="cpu", output=output, **options)
    return StageRecord.load(output).facts


def finish(rows: list[MemberRow]) -> None:
    """The jobs of the fits themselves."""
    for row in rows:
        for output, given in row.jobs.items():
            fit(**given, settings=read_settings(row.settings), **row.options, device="cpu", output=Path(output))


@pytest.fixture(scope="module")
def alone(started: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fits one by one."""
    folder = tmp_path_factory.mktemp("alone")
    finish(rows_of(started, folder))
    return folder


def assert_same(got: Path, wanted: Path) -> None:
    """Equal twins and histories, bit for bit."""
    for name in ROWS:
        for seed in ("0", "1"):
            one, other = (folder / name / seed for folder in (got, wanted))
            histories = (pd.read_parquet(folder / "history.parquet") for folder in (one, other))
            pd.testing.assert_frame_equal(*histories, check_exact=True)
            twins = [Twin.load(folder / "twin.npz") for folder in (one, other)]
            assert twins[0].simulation == twins[1].simulation
            for array in ("stiffness", "dashpot"):
                np.testing.assert_array_equal(*(getattr(twin.material, array) for twin in twins))
            records = [StageRecord.load(folder / "fit.json") for folder in (one, other)]
            assert (records[0].settings, records[0].inputs) == (records[1].settings, records[1].inputs)


@pytest.mark.parametrize("most", [0, 3])
def test_what_ran_together_is_continued_to_the_same_end(started: Path, alone: Path, tmp_path: Path, most: int) -> None:
    rows = rows_of(started, tmp_path)
    facts = together(rows, tmp_path / "fits.json", twins_per_launch=most or "auto")
    sizes = [len(batch) for batch in facts["batches"]]
    # Four of one horizon and two of another; of three at most, one would be alone, and is left to itself.
    assert sizes == ([4, 2] if most == 0 else [3, 2])
    assert facts["errors"] == {}
    finish(rows)
    assert_same(tmp_path, alone)
    shared = {path for batch in facts["batches"] for path in batch}
    for row in rows:
        for output in row.jobs:
            record = StageRecord.load(Path(output))
            assert (record.facts["epochs_together"], record.attempts) == (3 if output in shared else 0, 1)
            assert (record.facts["spring_updates"] == 0) == (output in shared)
            assert (record.facts["earlier_processor_seconds"] > 0) == (output in shared)
            assert not Path(output).with_name("fit.partial.npz").exists()


def test_finished_fits_and_failed_searches_are_left_alone(started: Path, alone: Path, tmp_path: Path) -> None:
    rows = rows_of(started, alone)
    broken = tmp_path / "failed.json"
    replace(StageRecord.load(started / "search-0" / "search.json"), status="failed", reason="x").save(broken)
    rows.append(MemberRow(jobs={str(tmp_path / "a" / "fit.json"): inputs(started, broken)}))
    before = {path: path.stat().st_mtime_ns for path in alone.rglob("*") if path.is_file()}
    assert together(rows, tmp_path / "fits.json")["batches"] == []
    assert {path: path.stat().st_mtime_ns for path in alone.rglob("*") if path.is_file()} == before


def test_a_fit_with_other_settings_is_made_again(started: Path, alone: Path, tmp_path: Path) -> None:
    rows = rows_of(started, tmp_path)
    finish(rows)
    longer = [replace(row, settings=json.dumps({"fit": {"epochs": 4}})) for row in rows[:1]]
    assert len(together(longer, tmp_path / "fits.json")["batches"][0]) == 2


def test_an_error_of_one_is_named_and_holds_nobody_up(
    started: Path, alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, original = rows_of(started, tmp_path), twin_fit.fit

    def failing(problem: object, *, partial: Path, **more: object) -> object:
        if partial.parent == tmp_path / "field" / "1":
            raise MemoryError("too large")
        return original(problem, partial=partial, **more)

    with monkeypatch.context() as patch:
        patch.setattr(twin_fit, "fit", failing)
        errors = together(rows, tmp_path / "fits.json")["errors"]
    assert errors == {str(tmp_path / "field" / "1" / "fit.json"): "MemoryError: too large"}
    finish(rows)
    assert_same(tmp_path, alone)


@pytest.mark.parametrize(
    ("given", "message"), [("{", "must be JSON"), ("{}", "must be a JSON list"), ('[{"kind": "x"}]', "entry 0")]
)
def test_bad_rows(started: Path, tmp_path: Path, given: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        together(given, tmp_path / "fits.json")
