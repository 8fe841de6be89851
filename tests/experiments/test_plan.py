"""Expected cost of a run, from recorded times; what a cluster is asked for."""

import dataclasses
from types import SimpleNamespace

import pytest
from snakemake.resources import Resource

from neuspring import config
from neuspring.config.gpus import Gpus
from neuspring.config.tuning import Tune
from neuspring.core.errors import InputError
from neuspring.core.job_records import GIGA_UPDATES, SIMULATING, Attempt, JobRecord
from neuspring.experiments import needs, plan, size
from neuspring.experiments.benchmark import Benchmark, check_storage
from tests.support.project import ROOT, config_with


def record(rule, scenario, seconds, work=1.0, outcome="ok", devices=(), memory=0.0):
    attempt = Attempt(
        started="2026-01-01T00:00:00+00:00", seconds=seconds, outcome=outcome, devices=list(devices), peak_memory_mb=memory
    )
    unit = GIGA_UPDATES if rule in SIMULATING else ""
    return JobRecord(rule=rule, name=f"{rule}/{scenario}", log="", attempts=[attempt], scenario=scenario, work=work, unit=unit)


def job(rule, scenario="rope", kind="cpu", work=1.0):
    return plan.Planned(rule=rule, scenario=scenario, kind=kind, work=work)


def test_times_scale_with_work_and_come_from_the_same_scenario_first():
    records = [record("fit", "rope", 20, 100), record("fit", "cloth", 90, 100), record("fit", "toy", 40, 100)]
    history = plan.History.of_records(records)
    for scenario, seconds in {"rope": 0.2, "cloth": 0.9, "unknown": 0.4}.items():
        found = plan.rate(job("fit", scenario), history, {})
        assert found == plan.Rate(seconds=seconds, source="this results folder")


def test_attempts_that_failed_say_nothing_of_time_but_of_memory():
    history = plan.History.of_records([record("fit", "rope", 3, outcome="transient", memory=900.0)])
    assert plan.rate(job("fit"), history, {}) is None
    assert history.memory == {("fit", "cpu", ""): 900.0, ("fit", "cpu", "rope"): 900.0}


def test_what_is_not_recorded_comes_from_the_shipped_times_and_says_so():
    shipped = {("fit", "cpu"): plan.Rate(seconds=2.0, source="a demo")}
    assert plan.rate(job("fit"), plan.History(), shipped) == plan.Rate(seconds=2.0, source="a demo")
    found = plan.rate(job("fit", kind="gpu"), plan.History(), shipped)
    assert found == plan.Rate(seconds=2.0, source="a demo, for want of a record on a GPU")
    assert plan.rate(job("unheard_of"), plan.History(), shipped) is None


def test_a_small_scene_predicts_a_large_one(benchmark):
    history = plan.History.of_records([record("search", "small", 20, 0.5)])
    large = plan.Planned(rule="search", scenario="large", work=2000.0)
    found = plan.rate(large, history, {})
    assert found is not None and found.seconds * large.work == pytest.approx(20 * 2000 / 0.5)


def test_a_record_whose_spring_updates_nobody_counted_is_not_used_and_the_plan_says_so():
    older = dataclasses.replace(record("fit", "rope", 3600, 880.0), unit="")
    jobs = [job("fit", work=5.0)]
    alone, both = (plan.History.of_records(records) for records in ([older], [older, record("fit", "rope", 50, 5.0)]))
    assert alone.rates == {} and both.rates["fit", "cpu", "rope"] == 10.0
    note = "times of earlier jobs without a count of spring updates are not used: fit"
    assert note in plan.report(jobs, alone, {}) and note in plan.report(jobs, both, {})
    assert note not in plan.report(jobs, plan.History.of_records([record("fit", "rope", 50, 5.0)]), {})
    # Frames of other rules are what they were.
    assert plan.History.of_records([record("score", "rope", 5, 10.0)]).rates["score", "cpu", ""] == 0.5


def test_the_plan_says_what_springs_and_substeps_rest_on():
    sizes = [
        size.Size(springs=100, substeps=10, springs_from=size.RECORD, substeps_from=size.RECORD),
        size.Size(springs=100, substeps=10, springs_from=size.SETTINGS, substeps_from=size.OTHERS),
        size.Size(springs=100, substeps=10, springs_from=size.SETTINGS, substeps_from=size.OTHERS),
    ]
    jobs = [dataclasses.replace(job("fit", name), size=each) for name, each in zip("abc", sizes, strict=True)]
    text = plan.report([*jobs, jobs[0]], plan.History.of_records([record("fit", "a", 1.0)]), {})
    assert "springs from the search's record: a\n  springs from the settings: 2 scenarios" in text
    assert "substeps from searches of other scenarios: 2 scenarios" in text


def test_a_transfer_of_a_baseline_has_no_springs_and_is_not_counted(benchmark):
    history = plan.History.of_records([record("transfer", "rope", 1.0)])
    text = plan.report([dataclasses.replace(job("transfer"), work=None)], history, {})
    assert "not counted: transfer" in text and "no time on record." in text


def test_a_small_plan_is_told_in_minutes_rule_by_rule():
    rules = ("segment", "track", "lift", "observe", "search", "fit", "score")
    history = plan.History.of_records([record(rule, "rope", 30.0 if rule == "fit" else 1.0, 1.0) for rule in rules])
    text = plan.report([job(rule, work=10.0) for rule in rules], history, {"gpu": 0, "cpu": 2})
    assert "Expected: 7 jobs, 6 CPU-minutes." in text
    assert "  fit: 1 jobs, 5 CPU-minutes" in text
    assert "with 2 cores: at least 3 minutes" in text
    assert "  observe: 1 jobs, less than 1 CPU-minute" in text
    assert all(f"  {rule}: 1 jobs, " in text for rule in rules)


def test_the_plan_counts_hours_slots_and_what_is_unknown():
    history = plan.History.of_records([record("fit", "rope", 36, 10, devices=["0"]), record("observe", "rope", 36)])
    jobs = [job("fit", kind="gpu", work=1000.0)] * 80 + [job("observe")] * 10 + [job("unheard_of")]
    text = plan.report(jobs, history, {"gpu": 8, "cpu": 0})
    assert "Expected: 91 jobs, 80.0 GPU-hours and 6 CPU-minutes." in text
    assert "fit: 80 jobs, 80.00 GPU-hours" in text
    assert "with 8 GPU slots: at least 10.0 hours" in text
    assert "not counted: unheard_of" in text
    assert plan.report([], history, {}) == ""


def test_every_rule_that_takes_long_has_a_shipped_time():
    rates = plan.shipped_rates()
    assert {"capture", "segment", "track", "lift", "observe", "search", "fit", "rollout", "score"} <= {rule for rule, _ in rates}
    assert {(rule, kind) for rule in SIMULATING for kind in ("cpu", "gpu")} <= set(rates)
    # Nanoseconds per spring, substep and twin: a core needs tens of them, a GPU about one.
    assert all(rates[rule, "cpu"].seconds > 5 > rates[rule, "gpu"].seconds for rule in SIMULATING)
    assert all(rate.seconds > 0 and rate.source for rate in rates.values())


@pytest.fixture
def benchmark(tmp_path):
    changes = {"results": str(tmp_path), "methods": ["baseline"], "search": {"rollouts": 100}, "fit": {"epochs": 30}}
    return Benchmark.of(config_with(changes), ROOT)


def test_frames_simulated_are_rollouts_or_epochs_times_training_frames(benchmark):
    wanted = needs.Needs(benchmark, "cpu")
    names = SimpleNamespace(seed=0, scenario=benchmark.config.scenarios[0], search="uniform", method="baseline")
    # 8 frames, of which 70 % are for training; frame 0 is given.
    assert [wanted.work(rule, names) for rule in ("search", "fit", "rollout", "score")] == [100 * 5, 30 * 5, 7, 8]


def test_lengths_of_released_and_synthetic_scenes_are_known(tmp_path):
    data = {"data_root": str(tmp_path)}
    (tmp_path / "data/different_types/weird_package").mkdir(parents=True)
    names = ["weird_package", "synthetic_weird_package"]
    chosen = Benchmark.of(config_with(data | {"scenarios": names, "synthetic": {"frames": 30}}), ROOT)
    wanted = needs.Needs(chosen, "cpu")
    assert [wanted.frames(name) for name in names] == [39, 30]


def test_a_cluster_is_asked_for_what_earlier_jobs_needed_and_for_more_at_each_attempt(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(needs.Needs, "amount", lambda self, rule, wildcards: (4800.0, None))
    wanted = needs.Needs(benchmark, "cpu")
    memory, minutes = wanted.memory("fit"), wanted.minutes("fit")
    assert [memory(None, attempt) for attempt in (1, 2)] == [8000, 16000]
    assert [minutes(None, attempt) for attempt in (1, 2)] == [480, 960]
    record("fit", "rope", 125, 1000, memory=2000.0).save(tmp_path)
    wanted = needs.Needs(benchmark, "cpu")
    memory, minutes = wanted.memory("fit"), wanted.minutes("fit")
    rope, cloth = SimpleNamespace(seed=0, scenario="rope"), SimpleNamespace(scenario="cloth")
    # 0.125 s per unit: 600 s, times three. A second attempt is not held to what may have been too little.
    assert [memory(rope, attempt) for attempt in (1, 2, 3)] == [3000, 16000, 24000]
    assert [minutes(rope, attempt) for attempt in (1, 2)] == [30, 960]
    # Of another scenario no more is known than that it may need as much.
    assert [memory(cloth, 1), minutes(cloth, 1)] == [8000, 480]
    record("fit", "sloth", 125, 1000, memory=20000.0).save(tmp_path)
    memory = needs.Needs(benchmark, "cpu").memory("fit")
    assert [memory(cloth, 1), memory(rope, 1)] == [30000, 3000]
    # A job on the CPU says nothing of one on a GPU.
    on_gpu = needs.Needs(benchmark, "gpu")
    assert [on_gpu.memory("fit")(rope, 1), on_gpu.minutes("fit")(rope, 1)] == [8000, 480]


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
    assert (pool, needs.gpu_slots(pool, chosen.jobs_per_gpu, limit) if pool else 0) == expected


@pytest.mark.parametrize(
    ("visible", "settings", "device", "limit", "message"),
    [
        ("0,1", {"devices": [1, 2]}, "cuda", None, "every device must be one that this run may use; received 2; allowed: 0, 1"),
        ("", {}, "cuda", None, "device: cuda needs a GPU that this run may use, and there is none"),
        ("0,1", {"jobs_per_gpu": 2}, "cuda", 5, r"there are 4 GPU slots \(2 GPUs, gpus.jobs_per_gpu 2\); received 5"),
        ("0,1", {}, "cuda", 0, "jobs on a GPU need one; received 0"),
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
    wishes = {"fit": {"gpu": Resource("gpu", 3)}, "search": {"mem_mb": Resource("mem_mb", 9000)}}
    needs.check_gpus(wishes, ("0", "1", "2"))
    with pytest.raises(InputError, match=r"--set-resources fit:gpu: .* there are 2 \(0, 1\); received 3"):
        needs.check_gpus(wishes, ("0", "1"))


def test_workers_on_several_machines_need_a_database_that_locks_across_them():
    space = {"fit.learning_rate": {"low": 1e-4, "high": 1e-2}}
    study = {"study": "rate", "method": "baseline", "workers": 2, "space": space}
    tune = config.parse(Tune, study, "test")
    check_storage(tune, cluster=False)
    with pytest.raises(InputError, match="workers on several machines need storage"):
        check_storage(tune, cluster=True)
    check_storage(config.parse(Tune, study | {"storage": "postgresql://me@host/studies"}, "test"), cluster=True)
    check_storage(config.parse(Tune, study | {"workers": 1}, "test"), cluster=True)


def test_only_takes_a_part_by_scenario_category_method_and_seed():
    names = ["toy_rope_lift_smooth", "toy_rope_shake_smooth", "toy_cloth_lift_smooth"]
    all_of_it = {"scenarios": names, "methods": ["baseline", "clusters_2", "clusters_3"], "seeds": [0, 1, 2]}

    def chosen(only):
        part = Benchmark.of(config_with(all_of_it | {"only": only}), ROOT).config
        return part.scenarios, part.methods, part.seeds

    assert chosen("category=rope method=clusters_* seed=0,2") == (tuple(names[:2]), ("clusters_2", "clusters_3"), (0, 2))
    assert chosen("scenario=*_lift_* category=cloth")[0] == ("toy_cloth_lift_smooth",)
    assert chosen("")[0] == tuple(names)


def test_a_part_keeps_the_whole_that_tables_are_laid_out_for():
    part = {
        "methods": ["search_only", "baseline"],
        "seeds": [0, 1],
        "compare_with": "baseline",
        "only": "method=search_only seed=1",
    }
    made = Benchmark.of(config_with(part), ROOT)
    assert (made.config.methods, made.config.seeds) == (("search_only",), (1,))
    assert (made.whole.methods, made.whole.seeds, made.compared_with) == (("search_only", "baseline"), (0, 1), "baseline")


@pytest.mark.parametrize(
    ("only", "message"),
    [
        ("category=ropes", "category 'ropes' matches none of the configuration's; received rope"),
        ("method=neuspring", "method 'neuspring' matches none"),
        ("color=red", "terms scenario="),
        ("seed", "terms scenario="),
    ],
)
def test_a_part_that_is_not_there_is_explained(only, message):
    with pytest.raises(InputError, match=message):
        Benchmark.of(config_with({"only": only}), ROOT)


def test_a_job_that_went_on_after_a_kill_took_as_long_as_all_its_attempts():
    times = {"ok": 50.0, "killed": 900.0}
    attempts = [
        Attempt(started="2026-01-01T00:00:00+00:00", seconds=times[outcome], outcome=outcome) for outcome in ("ok", "killed", "ok")
    ]
    history = plan.History.of_records(
        [JobRecord(rule="score", name="score/a", log="", attempts=attempts, scenario="rope", work=10.0)]
    )
    assert plan.rate(job("score"), history, {}) == plan.Rate(seconds=95.0, source="this results folder")
