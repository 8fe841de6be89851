"""The jobs of a benchmark: their inputs, which are finished, and why a job runs again."""

import json
import os
import random
import shutil

import pytest

from neuspring import config
from neuspring.config.parse import read_yaml
from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord
from neuspring.experiments import messages, plan
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph
from neuspring.experiments.tasks import Tasks
from neuspring.stages.stage import _stamps
from tests.support.captures import describe
from tests.support.extensions import with_extensions
from tests.support.planned import counted, finish, planned, targets
from tests.support.project import ROOT, SCENE

THREE_SEEDS = {"seeds": [0, 1, 2], "methods": ["baseline", "neuspring"]}


@pytest.fixture
def finished(tmp_path):
    """A results folder in which all jobs have run, as far as their records tell."""
    graph = planned(tmp_path / "results")
    finish(graph, graph.todo(targets(graph)))
    return tmp_path / "results"


def todo(results, **changes):
    graph = planned(results, **changes)
    return counted(graph.todo(targets(graph)))


def test_finished_jobs_are_left_alone_wherever_the_folder_is_and_whatever_its_times_are(finished, tmp_path):
    assert todo(finished) == {}
    copy = shutil.copytree(finished, tmp_path / "copy")
    files = [path for path in copy.rglob("*") if path.is_file()]
    for place, path in enumerate(random.Random(0).sample(files, len(files))):
        os.utime(path, (1e9 + place, 1e9 + place))
    assert todo(copy) == {}
    assert sum(todo(tmp_path / "elsewhere").values()) == 7


@pytest.mark.parametrize(
    ("changes", "rules", "reason"),
    [
        ({"fit": {"epochs": 60}}, {"fit": 1, "run": 1}, "fit (1): fit.fit.epochs 3 -> 60"),
        ({"search": {"rollouts": 22}}, {"search": 1, "fit": 1, "run": 2}, "search (1): search.search.rollouts 11 -> 22"),
        ({"toy": {"frames": 9}}, {"perceive": 1, "search": 1, "fit": 1, "run": 2}, "perceive (1): observe.toy.frames 8 -> 9"),
        ({"seeds": [0, 1]}, {"search": 1, "fit": 1, "run": 2}, ""),
        ({"twins_per_launch": 4, "device": "auto", "tracking": {"experiment": "other"}}, {}, ""),
    ],
)
def test_a_changed_setting_makes_what_follows_from_it_again_and_says_why(finished, changes, rules, reason):
    found = todo(finished, **changes)
    assert {rule: count for rule, count in found.items() if rule not in ("tables", "page")} == rules
    graph = planned(finished, **changes)
    lines = plan.replaced(graph, graph.todo(targets(graph)))
    assert (reason in lines) if reason else not any(line.startswith(("run", "fit", "search", "perceive")) for line in lines)


def test_changed_code_is_named(finished):
    graph = planned(finished)
    unit = graph.unit("search", f"{SCENE}/uniform/0")
    record = JobRecord.load(graph.record(unit))
    record.made_of["search"]["code"] = "0123456789abcdef"
    graph.record(unit).unlink()
    record.save(graph.folder(unit) / "0123456789abcdef.json")
    assert plan.replaced(graph, [unit])[0] == "search (1): search.code"


def test_a_record_without_its_results_is_void(finished):
    graph = planned(finished)
    unit = graph.unit("run", f"{SCENE}/baseline/0")
    record = JobRecord.load(graph.record(unit))
    JobRecord(**{**record.__dict__, "files": [f"{SCENE}/baseline/0/run.json"]}).save(graph.record(unit))
    assert not graph.finished(unit) and not graph.record(unit).exists()
    graph.record(unit).write_text("damaged")
    assert not graph.finished(unit)


def test_an_image_of_the_user_that_was_changed_is_noticed(tmp_path):
    table = tmp_path / "scenarios.tsv"
    table.write_text("scenario\tsource\tcategory\tpath\tself_collision\tground\nmine\tcapture\ttoy\tmine\tfalse\ttrue\n")
    image = tmp_path / "mine" / "color" / "0" / "00000.png"
    image.parent.mkdir(parents=True)
    image.touch()
    (tmp_path / "mine" / "capture.json").write_text(json.dumps(config.plain(describe(masks=True))))
    given = {"perception": {"segment": {"backend": "given"}}, "data_root": str(tmp_path), "scenario_table": str(table)}

    def digest():
        _stamps.cache_clear()  # a plan looks once
        return planned(tmp_path / "results", scenarios=["mine"], **given).unit("perceive", "mine").digest

    before = digest()
    assert digest() == before
    image.write_text("another image")
    assert digest() != before


def test_batches_have_each_unit_once_and_what_is_finished_is_not_asked_for_again(tmp_path):
    graph = planned(tmp_path, **THREE_SEEDS)
    batch = graph.batches("fit")
    assert [len(one.members) for one in batch] == [6], "on a CPU the fits of a scenario, from three on"
    assert graph.batches("search") == []
    assert counted(graph.todo(targets(graph)))["fit"] == 1
    finish(graph, batch)
    # A seed more makes another batch; members that are finished are not planned alone.
    more = planned(tmp_path, **THREE_SEEDS | {"seeds": [0, 1, 2, 3]})
    assert more.job_of(more.unit("fit", f"{SCENE}/baseline/0")).members == ()
    assert len(more.job_of(more.unit("fit", f"{SCENE}/baseline/3")).members) == 8
    assert planned(tmp_path, **THREE_SEEDS, twins_per_launch=1).batches("fit") == []


@pytest.mark.parametrize(
    ("slots", "batch", "sizes"), [(2, "auto", [9, 9]), (0, "auto", [9, 9]), (2, 4, [3, 4, 3, 4, 4]), (2, 1, [])]
)
def test_batches_on_gpus_are_as_large_as_one_another_and_every_gpu_has_one(tmp_path, slots, batch, sizes):
    scenes = {"scenarios": [SCENE, "toy_rope_lift_two_region", "toy_rope_shake_smooth"], "methods": ["baseline", "neuspring"]}
    graph = planned(tmp_path, **scenes, seeds=[0, 1, 2], gpus={"batch": batch})
    graph.benchmark.on_gpu, graph.benchmark.gpu_slots = True, slots
    found = graph.batches("search")
    assert sorted(len(one.members) for one in found) == sorted(sizes)
    names = [member.name for one in found for member in one.members]
    assert len(set(names)) == len(names)


def test_what_cannot_be_planned_is_an_error(tmp_path):
    graph = planned(tmp_path)
    with pytest.raises(InputError, match="must have the form scenario/method/seed"):
        graph.unit("run", "nothing")
    with pytest.raises(InputError, match="is required for the target sweep"):
        graph.unit("sweep_report", "all")
    with pytest.raises(InputError, match="--cores: must not be set on a cluster"):
        messages.begin(graph, 1, local=False, cores=2, cluster=False)


def shipped(*names, **values):
    given = {}
    for name in ("config.yaml", *(f"data/{name}.yaml" for name in names)):
        config.merge(given, read_yaml(ROOT / "config" / name))
    return Graph(Benchmark(given | values, ROOT, plan_only=True))


@with_extensions
def test_the_demo_has_thirty_jobs_and_the_whole_benchmark_less_than_two_thousand(tmp_path):
    demo = shipped("demo", results=str(tmp_path / "demo"))
    Tasks(demo, {})
    found = counted(demo.todo(targets(demo)))
    assert found == {"perceive": 3, "search": 6, "fit": 6, "appearance": 3, "run": 9} | dict.fromkeys(
        ("tables", "page", "perception_table"), 1
    )
    steps = [step.stage.name for step in demo.unit("perceive", "synthetic_single_lift_sloth").steps]
    assert steps == ["capture", *["segment"] * 3, *["track"] * 3, "lift", "observe", "judge"]
    whole = shipped("phystwin", results=str(tmp_path / "whole"), data_root="nowhere")
    whole.benchmark.on_gpu = True
    assert sum(counted(whole.todo(whole.runs())).values()) < 2000
