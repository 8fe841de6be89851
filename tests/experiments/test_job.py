"""One job: it runs its steps in order, skips steps with matching records, and a failing batch member stops no other."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from pathlib import Path

import pytest

from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord, read_jobs
from neuspring.core.records import StageRecord
from neuspring.experiments import gpus
from neuspring.experiments.job import GIVEN, POOL, Runner
from neuspring.stages.stage import Written
from tests.support.planned import planned
from tests.support.project import SCENE

STATIC = {"methods": ["static"], "tracking": {"enabled": False}}


def run(graph, rule, name):
    """Run a job in this process; returns its log."""
    unit = graph.unit(rule, name)
    Runner(graph, graph.folder(unit) / f"{unit.digest}.log", 1).run(unit)
    return graph.record(unit).read_text()


def moments(results):
    """When each record of a stage was written."""
    found = [path for name in ("rollout", "score.record") for path in results.rglob(f"{name}.json")]
    return {path.relative_to(results).as_posix(): str(path.stat().st_mtime_ns) for path in found}


@pytest.fixture
def own(results):
    """A method that learns nothing: two jobs of a tenth of a second."""
    return planned(results, **STATIC)


def test_a_run_ends_with_its_record_and_the_same_plan_has_nothing_left(own, capsys):
    run(own, "perceive", SCENE)
    run(own, "run", f"{SCENE}/static/0")
    results = Path(own.results)
    assert (results / SCENE / "static" / "0" / "run.json").exists()
    again = planned(results, **STATIC)
    assert again.todo(again.runs()) == []
    before = moments(results)
    run(again, "run", f"{SCENE}/static/0")
    assert moments(results) == before and capsys.readouterr().out.count("already finished") == 2
    record = JobRecord.load(again.record(again.runs()[0]))
    assert (record.outcome, record.scenario, record.log.split("/")[0]) == ("ok", SCENE, "jobs")
    assert set(record.made_of) == {"predict", "score"} and len(record.files) == 2


def test_a_step_whose_inputs_have_the_same_content_is_skipped_though_an_earlier_one_ran_again(own, capsys):
    run(own, "perceive", SCENE)
    run(own, "run", f"{SCENE}/static/0")
    results, before = Path(own.results), moments(Path(own.results))
    (results / SCENE / "observations.npz").unlink()
    again = planned(results, **STATIC)
    assert [unit.rule for unit in again.todo([again.unit("perceive", SCENE)])] == ["perceive"]
    run(again, "perceive", SCENE)
    run(again, "run", f"{SCENE}/static/0")
    assert moments(results) == before


def test_other_settings_replace_the_record_of_the_job(own):
    run(own, "perceive", SCENE)
    first = own.record(own.unit("perceive", SCENE))
    changed = planned(own.results, **STATIC, toy={"frames": 9})
    assert not changed.finished(changed.unit("perceive", SCENE))
    run(changed, "perceive", SCENE)
    assert not first.exists() and changed.finished(changed.unit("perceive", SCENE))
    assert Observations.load(Path(own.results, SCENE, "observations.npz")).scenario.frame_count == 9, "the step ran again"


def test_a_job_without_its_inputs_says_which(own):
    with pytest.raises(InputError, match="this file must be readable"):
        run(own, "run", f"{SCENE}/static/0")


def batched(results, calls, **changes):
    """Three searches in a batch, which write their seed in place of a twin. Seed 1 fails in the batch, seed 2 wherever it runs."""
    given = {"methods": ["search_only"], "seeds": [0, 1, 2], "gpus": {"batch": 3}} | changes
    graph = planned(results, **given)
    real = graph.rules["search"][0]

    @functools.wraps(real.function)
    def search(run, seed, settings, **others) -> Written:
        calls.append([seed])
        if seed == 2 and settings.search.rollouts == 11:
            raise ValueError("its data are damaged")
        files = run.beside(twin="twin.npz")
        files["twin"].write_text(str(seed))
        return Written(files=files)

    def many(jobs):
        calls.append([job.values["seed"] for job in jobs])
        made = [ValueError("out of memory") if job.values["seed"] else search(**job.arguments) for job in jobs]
        return made

    graph.rules["search"] = [dataclasses.replace(real, function=search, many=many)]
    return graph


def test_a_failing_member_of_a_batch_stops_no_other_and_is_alone_what_is_left(results):
    calls = []
    graph = batched(results, calls)
    run(graph, "perceive", SCENE)
    run(graph, "search", "together/0")
    assert calls == [[0, 1, 2], [0], [1], [2]], "two failed in the batch, and were tried once more alone"
    seeds = [graph.finished(graph.unit("search", f"{SCENE}/uniform/{seed}")) for seed in range(3)]
    assert seeds == [True, True, False]
    [failed] = [record for record in read_jobs(results) if record.outcome == "failed"]
    assert (failed.name, failed.message) == (f"search/{SCENE}/uniform/2", "its data are damaged")
    record = StageRecord.load(results / SCENE / "search-uniform" / "0" / "search.json")
    assert record.seconds < 5
    # The batch is planned again for the one that failed; finished members are left alone.
    again = batched(results, calls)
    assert [unit.name for unit in again.todo(again.runs()) if unit.rule == "search"] == ["together/0"]
    calls.clear()
    run(again, "search", "together/0")
    assert calls == [[2]]


def test_devices_of_a_job_are_its_own(own, monkeypatch, tmp_path):
    runner = Runner(own, tmp_path / "jobs" / "run" / "x" / "0.log", 1)
    monkeypatch.setattr(gpus, "nvml", contextlib.nullcontext)
    monkeypatch.setenv(POOL, "4,7")
    monkeypatch.setenv(gpus.VISIBLE, "")
    Path(own.results, "jobs").mkdir()
    runner.lease(1)
    assert runner.devices == ["4"] and os.environ[gpus.VISIBLE] == "4"
    runner.note("RuntimeError: CUDA error: unspecified launch failure")
    other = Runner(own, runner.log, 1)
    runner.held.release()
    other.lease(1)
    assert other.devices == ["7"], "a device that failed a job is the last choice"
    other.held.release()
    other.lease(0)
    assert os.environ[gpus.VISIBLE] == ""
    monkeypatch.setenv(POOL, GIVEN)
    monkeypatch.setenv(gpus.VISIBLE, "2")
    given = Runner(own, runner.log, 1)
    given.lease(1)
    assert given.devices == ["2"]
