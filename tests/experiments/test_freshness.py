"""Results are compared with what would be made now by their own records."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuspring import config
from neuspring.core.job_records import Attempt, JobRecord
from neuspring.core.provenance import image_stamps
from neuspring.core.records import Recorder
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.freshness import Freshness, stamp_of, stamped, told
from neuspring.experiments.graph import Graph
from neuspring.experiments.messages import replaced
from neuspring.stages import STAGES
from neuspring.stages.stage import _stamps
from tests.support.captures import describe
from tests.support.project import ROOT, SCENE, config_with

JOB = SimpleNamespace(scenario=SCENE, method="baseline", search="uniform", seed="0")


def graph(results: Path, **changes: Any) -> Graph:
    return Graph(Benchmark(config_with({"results": str(results)} | changes), ROOT))


def record(made: Graph, stage: str, job: Any = JOB, **changes: Any) -> Path:
    """What a job would leave: its output, and the record of how it was made."""
    declared = STAGES[stage]
    output, files = Path(made.output_of(declared, job)), made.inputs(declared)(job)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.touch()
    inputs = {name: Path(files[name]) for name in declared.inputs if isinstance(files.get(name), str)}
    facts = {"settings": made.recorded(declared, job), "code": made.code(declared, job), "inputs": inputs}
    Recorder(stage, declared.record_of(output), **(facts | changes)).save()
    return output


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A finished run, as far as its records tell."""
    made = graph(tmp_path / "results")
    for stage in ("observe", "search", "fit", "rollout", "score"):
        record(made, stage)
    return tmp_path / "results"


def looked(made: Graph) -> dict[str, tuple[str, ...]]:
    fresh = Freshness(made)
    found = {stage: fresh.look(STAGES[stage], JOB) for stage in ("observe", "search", "fit", "rollout", "score")}
    return {stage: departures for stage, departures in found.items() if departures}


def test_what_was_made_as_it_would_be_now_is_left_alone_wherever_the_folder_lies(results, tmp_path):
    assert looked(graph(results)) == {}
    assert looked(graph(results.rename(tmp_path / "kept"))) == {}
    assert looked(graph(tmp_path / "elsewhere")) == {}, "what is not there is made anyway"


@pytest.mark.parametrize(
    ("changes", "departures"),
    [
        ({"fit": {"epochs": 60}}, {"fit": ("fit.epochs 3 -> 60",)}),
        ({"search": {"rollouts": 22}}, {"search": ("search.rollouts 11 -> 22",)}),
        ({"toy": {"frames": 9}}, {"observe": ("toy.frames 8 -> 9",)}),
        ({"simulation": {"safety": 0.3}}, dict.fromkeys(["search", "fit"], ("simulation.safety 0.8 -> 0.3",))),
        ({"twins_per_launch": 4, "device": "auto", "compare_with": "baseline"}, {}),
    ],
)
def test_settings_that_differ_are_named_at_the_stages_that_read_them(results, changes, departures):
    assert looked(graph(results, **changes)) == departures


def test_a_setting_that_is_gone_or_empty_now_is_named(results):
    made = graph(results)
    record(made, "fit", settings=made.recorded(STAGES["fit"], JOB) | {"boxes": {"0": [1, 2]}})
    assert Freshness(made).look(STAGES["fit"], JOB) == ("boxes.0 [1, 2] -> null",)
    record(made, "fit").with_name("fit.json").write_text('{"format": 2, "settings": {}, "inputs": {}}')
    assert Freshness(made).look(STAGES["fit"], JOB) == ("no record of how it was made",)


def test_code_inputs_and_missing_records_count_too(results):
    made = graph(results)
    record(made, "search", code="0123456789abcdef")
    # The records behind it name the search that they were made from.
    assert looked(made) == {"search": ("code",)} | dict.fromkeys(["fit", "score"], ("input search",))
    record(made, "search", code="")
    assert looked(made)["search"] == ("code (an older version)",)
    (results / SCENE / "observe.record.json").unlink()
    assert looked(made)["observe"] == ("no record of how it was made",)
    record(made, "rollout", inputs={})
    assert looked(made)["rollout"] == ("input observations", "input learned")
    Recorder("predict", results / SCENE / "baseline" / "0" / "rollout.json").save()
    assert looked(made)["rollout"][0] == "made by predict"


def test_an_image_that_was_changed_is_noticed(tmp_path):
    table = tmp_path / "scenarios.tsv"
    table.write_text("scenario\tsource\tcategory\tpath\tself_collision\tground\nmine\tcapture\ttoy\tmine\tfalse\ttrue\n")
    image = tmp_path / "mine" / "color" / "0" / "00000.png"
    image.parent.mkdir(parents=True)
    image.touch()
    (tmp_path / "mine" / "capture.json").write_text(json.dumps(config.plain(describe(masks=True))))
    given = {"perception": {"segment": {"backend": "given"}}, "data_root": str(tmp_path), "scenario_table": str(table)}
    made = graph(tmp_path / "results", scenarios=["mine"], **given)
    job = SimpleNamespace(scenario="mine", camera="0")
    output = record(made, "segment", job)
    values = json.loads(output.read_text())
    values["inputs"]["images"] = image_stamps(tmp_path / "mine")
    output.write_text(json.dumps(values))
    assert Freshness(made).look(STAGES["segment"], job) == ()
    image.write_text("another image")
    again = graph(tmp_path / "results", scenarios=["mine"], **given)
    _stamps.cache_clear()  # a plan looks once
    assert Freshness(again).look(STAGES["segment"], job) == ("images",)


def test_fits_share_launches_again_only_where_one_of_them_is_still_to_be_done(results):
    made = graph(results, seeds=[0, 1, 2])
    members = [SimpleNamespace(scenario=SCENE, method="baseline", search="uniform", seed=str(seed)) for seed in range(3)]
    for job in members:
        record(made, "search", job)
        record(made, "fit", job)
    launch = SimpleNamespace(scenario=SCENE, launch=0)
    record(made, "fits", launch)
    assert Freshness(made).look(STAGES["fits"], launch) == ()
    again = graph(results, seeds=[0, 1, 2], fit={"epochs": 60})
    assert Freshness(again).look(STAGES["fits"], launch) == ("its fits are not finished",)


def test_runs_that_were_made_with_another_configuration_are_named_for_the_tables(results):
    assert Freshness(graph(results, methods=["baseline"])).of_runs() == []
    lines = Freshness(graph(results, methods=["baseline"], fit={"epochs": 60}, search={"rollouts": 22})).of_runs()
    assert lines == ["  search (uniform, 1 job): search.rollouts 11 -> 22", "  fit (baseline, 1 job): fit.epochs 3 -> 60"]


def test_what_is_made_again_is_said_once_for_jobs_alike():
    why = tuple(f"fit.a{number} 1 -> 2" for number in range(8))
    jobs = [("fit", SimpleNamespace(method=method, seed=0), why) for method in ("baseline", "neuspring", "baseline")]
    text = replaced(jobs)
    assert text.splitlines()[1] == f"  fit (baseline, neuspring, 3 jobs): {', '.join(why[:6])}, 2 more"
    assert "--config results=" in text and "--rerun-triggers mtime" in text
    assert replaced([]) == "" and told([]) == []


def test_a_stamp_follows_words_and_code_and_not_the_place_of_the_results(tmp_path):
    words = ["--results", "a/b", "--output", "a/b/tables", "--methods", "a", "--settings", '{"results": "a/b", "seeds": [0]}']
    words.append("/project/config/studies.yaml")

    def stamp(results: str, root: str = "/project") -> str:
        told = [word.replace("a/b", results).replace("/project", root) for word in words]
        return stamp_of(results, Path(root), told, "neuspring.core.text")

    assert stamp("a/b") == stamp("c") == stamp("/project/res ults") == stamp("/elsewhere", "/moved") == stamp("/moved/c", "/moved")
    assert stamp("a/b") != stamp_of("a/b", Path("/project"), [*words, "b"], "neuspring.core.text")
    log = tmp_path / "logs" / "tables" / "tables.log"
    assert not stamped(tmp_path, log, "x")
    of_log = JobRecord.of_log(tmp_path, log)
    attempt = Attempt(started="2026-11-22T10:00:00.000+00:00", outcome="ok")
    JobRecord(**{**of_log.__dict__, "attempts": [attempt], "stamp": "x"}).save(tmp_path)
    assert stamped(tmp_path, log, "x") and not stamped(tmp_path, log, "y")
