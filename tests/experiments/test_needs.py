"""Memory and time that jobs ask for, from the records of earlier jobs; GPUs that jobs may lease."""

from types import SimpleNamespace

import pytest

from neuspring import config
from neuspring.config.settings import Gpus
from neuspring.core.errors import InputError
from neuspring.core.job_records import Attempt, JobRecord
from neuspring.experiments import needs
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.needs import History, Needs
from tests.support.project import ROOT, config_with


def record(rule, scenario, *attempts, devices=(), memory=0.0):
    """A job whose attempts took so many seconds and ended so."""
    made = [
        Attempt(started="2026-01-01T00:00:00+00:00", seconds=seconds, outcome=how, devices=list(devices), peak_memory_mb=memory)
        for seconds, how in attempts
    ]
    return JobRecord(rule=rule, name=f"{rule}/{scenario}", log="", attempts=made, scenario=scenario)


def test_attempts_that_failed_say_nothing_of_time_but_of_memory():
    history = History.of([record("fit", "rope", (3, "transient"), memory=900.0)])
    assert history == History({}, {("fit", "cpu", ""): 900.0, ("fit", "cpu", "rope"): 900.0})


def test_a_job_that_went_on_after_a_kill_took_as_long_as_all_its_attempts():
    assert History.of([record("fit", "rope", (50, "ok"), (900, "killed"), (50, "ok"))]).seconds["fit", "cpu", "rope"] == 950


def test_a_cluster_is_asked_for_what_earlier_jobs_needed_and_for_more_at_each_attempt(tmp_path):
    benchmark = Benchmark(config_with({"results": str(tmp_path), "methods": ["baseline"]}), ROOT)
    rope, cloth = SimpleNamespace(seed=0, scenario="rope"), SimpleNamespace(scenario="cloth")

    def asked(wildcards, attempt, kind="cpu"):
        wanted = Needs(benchmark, kind)
        return wanted.memory("fit")(wildcards, attempt), wanted.minutes("fit")(wildcards, attempt)

    assert [asked(rope, attempt) for attempt in (1, 2)] == [(8000, 480), (16000, 960)]
    record("fit", "rope", (600, "ok"), memory=2000.0).save(tmp_path)
    # A second attempt is not held to what may have been too little.
    assert [asked(rope, attempt) for attempt in (1, 2, 3)] == [(3000, 30), (16000, 960), (24000, 1440)]
    # Of another scenario no more is known than that it may need as much.
    assert asked(cloth, 1) == (8000, 480)
    record("fit", "sloth", (20_000, "ok"), memory=20_000.0).save(tmp_path)
    assert asked(cloth, 1) == (30_000, 1000)
    assert asked(rope, 1) == (3000, 30)
    # A job on the CPU says nothing of one on a GPU.
    assert asked(rope, 1, kind="gpu") == (8000, 480)


@pytest.mark.parametrize(
    ("visible", "settings", "device", "limit", "expected"),
    [
        ("0,1,2", {}, "auto", None, (("0", "1", "2"), 3)),
        ("0,1,2", {"devices": [1, 2], "jobs_per_gpu": 2}, "cuda", None, (("1", "2"), 4)),
        ("0,1,2", {"jobs_per_gpu": 2}, "cuda", 5, (("0", "1", "2"), 5)),
        ("", {}, "auto", None, ((), 0)),
        ("0,1", {}, "cpu", None, ((), 0)),
    ],
)
def test_gpu_slots_are_those_that_the_user_allows(monkeypatch, visible, settings, device, limit, expected):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    chosen = config.parse(config.Config, {"gpus": settings}, "test").gpus
    pool = needs.gpu_pool(chosen, device)
    assert (pool, needs.gpu_slots(pool, chosen.jobs_per_gpu, limit)) == expected


@pytest.mark.parametrize(
    ("visible", "settings", "device", "limit", "message"),
    [
        ("0,1", {"devices": [1, 2]}, "cuda", None, "every device must be one that this run may use; received 2; allowed: 0, 1"),
        ("", {}, "cuda", None, "device: cuda needs a GPU that this run may use, and there is none"),
        ("0,1", {"jobs_per_gpu": 2}, "cuda", 5, r"there are 4 GPU slots \(2 GPUs, gpus.jobs_per_gpu 2\); received 5"),
        ("", {}, "auto", 2, "no job of this run can have a GPU; received 2"),
        ("0,1", {}, "cuda", 0, r"at least one, and there are 2 GPU slots .*received 0"),
    ],
)
def test_asking_for_more_than_there_is_ends_the_run_before_it_begins(monkeypatch, visible, settings, device, limit, message):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    chosen = config.parse(config.Config, {"gpus": settings}, "test").gpus
    with pytest.raises(InputError, match=message):
        needs.gpu_slots(needs.gpu_pool(chosen, device), chosen.jobs_per_gpu, limit)


def test_a_plan_for_gpus_can_be_made_where_there_is_none(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert needs.gpu_pool(Gpus(), "cuda", plan_only=True) == ()


def test_resources_set_for_a_rule_beyond_the_gpus_there_are_are_refused():
    needs.check_gpus({"fit": 3}, ("0", "1", "2"))
    with pytest.raises(InputError, match=r"--set-resources fit:gpu: .* there are 2 \(0, 1\); received 3"):
        needs.check_gpus({"fit": 3}, ("0", "1"))


def test_a_results_folder_that_cannot_be_written_ends_the_run_before_it_begins():
    with pytest.raises(InputError, match="this folder must be writable"):
        needs.checked(config_with({"results": "/proc/nowhere"}), ROOT)
