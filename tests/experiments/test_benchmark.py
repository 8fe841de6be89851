"""The tables of methods, searches and scenarios, and what is checked of a benchmark before any job."""

from __future__ import annotations

import functools
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from neuspring import config
from neuspring.config import Config, Method, parse
from neuspring.core.errors import InputError
from neuspring.core.records import Before, Recorder
from neuspring.experiments import benchmark as tables
from neuspring.experiments import plan
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph, behind
from neuspring.scenes.sources import SOURCES, read_scenarios, scenario_rows
from neuspring.scores.paper import read_studies
from neuspring.stages import STAGES
from neuspring.stages.stage import Written, stage
from tests.support.captures import describe
from tests.support.colored import paint
from tests.support.extensions import with_extensions
from tests.support.project import config_with

# The configurations that are shipped name rows and sources of extensions.
pytestmark = with_extensions

ROOT = Path(__file__).parents[2]


def load(text):
    return parse(Config, yaml.safe_load("scenarios: [rope]\nmethods: [ours]\n" + text), "config.yaml")


# Methods --------------------------------------------------------------------------------------------------------------

METHODS = """
full: {search: uniform, fit: springs, description: both stages}
coarse: {search: uniform, fit: null, description: search only}
long:
  search: uniform
  fit: springs
  description: through all frames
  settings: {horizon: 0, epochs: 7}
ours: {search: pieces, fit: field, description: x, settings: {output_bound: 1.5, field: {triplane: false}}}
"""
read_searches = functools.partial(tables.read_searches, clusters=5)
SEARCHES = """
uniform: {clusters: 1, description: one region}
pieces:
  clusters: 5
  description: five regions
  settings: {rollouts: 33, hands: auto}
"""


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_lie_on_top_of_the_configuration(tmp_path):
    found = tables.read_methods(write(tmp_path / "methods.yaml", METHODS))
    assert [found[name].fit for name in ("full", "coarse", "long", "ours")] == ["springs", None, "springs", "field"]
    made = load("fit: {epochs: 3, learning_rate: 0.5, field: {resolution: 8}}\nsearch: {rollouts: 44, tied_rollouts: 5}")
    merged = tables.with_method(made, found["long"], "long").fit
    assert (merged.horizon, merged.epochs, merged.learning_rate) == (0, 7, 0.5)
    assert tables.with_method(made, found["full"], "full") == made
    ours = tables.with_method(made, found["ours"], "ours").fit
    assert (ours.epochs, ours.output_bound, ours.field.triplane, ours.field.resolution) == (3, 1.5, False, 8)
    rows = read_searches(write(tmp_path / "searches.yaml", SEARCHES))
    assert {name: row.clusters for name, row in rows.items()} == {"uniform": 1, "pieces": 5}
    searched = tables.with_search(made, rows["pieces"], "pieces").search
    assert (searched.rollouts, searched.tied_rollouts, searched.hands) == (33, 5, "auto")
    assert tables.with_search(made, rows["uniform"], "uniform") == made


# Scenarios ------------------------------------------------------------------------------------------------------------

HEADER = "scenario\tsource\tcategory\tpath\tself_collision\tground\n"
ROW = "rope\ttoy\ttoy\trope\tfalse\ttrue\n"


def test_scenarios(tmp_path):
    path = write(tmp_path / "scenarios.tsv", f"# a comment\n{HEADER}\n{ROW}# more\ncloth\tphystwin\tcloth\ta/b c\ttrue\tfalse\n")
    rows = read_scenarios(path)
    assert list(rows) == ["rope", "cloth"]
    assert (rows["rope"].ground, rows["rope"].self_collision, rows["cloth"].self_collision) == (True, False, True)
    assert rows["cloth"].path == "a/b c"


BAD_TABLES = {
    "no regions": (read_searches, "a: {clusters: 0, description: x}", "search a.*clusters.*received 0"),
    "key": (read_searches, "a: {clusters: 1, description: x, linkage: ward}", "search a.*linkage: unknown key"),
    "nothing to extend": (
        read_searches,
        "a: {extends: b, description: x}",
        "search a: extends: another row of this table.*received b",
    ),
    "rows that extend each other": (read_searches, "a: {extends: b}\nb: {extends: a}", "search b: extends: .*; received a"),
    "search": (tables.read_methods, "a: {search: ../up, description: x}", r"method a.*search.*received '\.\./up'"),
    "fit": (tables.read_methods, "a: {search: uniform, fit: network, description: x}", "method a.*fit.*received 'network'"),
    "body": (read_searches, "a: {clusters: 1, body: jelly, description: x}", "search a, body: must be one of lattice, rod"),
    "missing": (tables.read_methods, "a: {search: uniform, fit: null}", "method a.*description: required, but missing"),
    "not a mapping": (tables.read_methods, "a: 3", "method a"),
    "empty": (tables.read_methods, "", "must contain a YAML mapping; received NoneType"),
    "not YAML": (tables.read_methods, "a: [", "must be YAML"),
    "no header": (read_scenarios, "", "the header must be"),
    "header": (read_scenarios, "name\tsource\n", r"the header must be the tab-separated columns \['scenario', 'source'"),
    "spaces": (read_scenarios, HEADER.replace("\t", " "), "the header must be"),
    "cells": (read_scenarios, HEADER + "rope\ttoy\n", "row 'rope': 6 tab-separated cells are required; received 2"),
    "flag": (read_scenarios, HEADER + ROW.replace("false", "no"), "row 'rope', self_collision: must be true or false; received no"),
    "source": (read_scenarios, HEADER + ROW.replace("\ttoy\ttoy", "\tweb\ttoy"), "row 'rope'.*source.*received 'web'"),
    "name": (read_scenarios, HEADER + "../" + ROW, r"row '\.\./rope'.*scenario"),
    "twice": (read_scenarios, HEADER + ROW + ROW, "row 'rope': scenario names must differ"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_bad_tables_are_refused_by_row_and_file(name, tmp_path):
    read, text, message = BAD_TABLES[name]
    path = write(tmp_path / "rows", text)
    with pytest.raises(InputError, match="(?s)" + message) as caught:
        read(path)
    assert str(path) in str(caught.value)


# A benchmark: the configuration with its tables -----------------------------------------------------------------------


def benchmark(root, **values):
    own = "mine\tcapture\ttoy\tmine\tfalse\ttrue\n"
    write(root / "scenarios.tsv", HEADER + ROW + "cable\tmocap\tcable\tcable.csv\tfalse\ttrue\n" + own)
    write(root / "methods.yaml", METHODS)
    write(root / "searches.yaml", SEARCHES)
    write(root / "studies.yaml", "both: {title: t, reference: null, baseline: Plain, rows: {Plain: full, Later: not_there}}")
    tables = {"scenario_table": "scenarios.tsv", "method_table": "methods.yaml", "search_table": "searches.yaml"}
    tables["study_table"] = "studies.yaml"
    return Benchmark({"scenarios": ["rope"], "methods": ["full"]} | tables | values, root)


def test_a_benchmark_holds_the_rows_it_names(tmp_path):
    made = benchmark(tmp_path, methods=["long", "full"])
    assert (list(made.scenarios), list(made.methods)) == (["rope"], ["long", "full"])
    assert list(made.searches) == ["uniform"], "shared by both, and no other"
    assert list(benchmark(tmp_path, methods=["ours", "coarse"]).searches) == ["pieces", "uniform"]
    assert made.methods_of("both") == ("full",), "a row whose method does not exist is no error"
    assert made.data_path("rope") is None
    (tmp_path / "cable.csv").touch()
    found = benchmark(tmp_path, scenarios=["cable"], data_root=str(tmp_path))
    assert found.data_path("cable") == tmp_path / "cable.csv"


def test_a_capture_in_data_root_is_a_scenario_without_a_row(tmp_path):
    for name, changes in {"towel": {}, "box": {"category": "box", "self_collision": True, "ground": False}, "mine": {}}.items():
        path = paint(tmp_path / name, frames=5).folder / "capture.json"
        write(path, json.dumps(json.loads(path.read_text()) | changes))
    (tmp_path / "half").mkdir()
    write(tmp_path / "half" / "capture.json", "{")
    whole = benchmark(tmp_path, scenarios=["towel", "box", "mine"], data_root=str(tmp_path))
    towel, box, mine = whole.scenarios.values()
    assert (towel.source, towel.category, towel.path) == ("capture", "cloth", "towel")
    assert (towel.self_collision, towel.ground) == (True, True)
    assert (box.category, box.self_collision, box.ground) == ("box", True, False)
    assert mine.category == "toy", "a row is believed before capture.json"
    with pytest.raises(InputError, match=r"half/capture\.json"):
        benchmark(tmp_path, scenarios=["half"], data_root=str(tmp_path))
    with pytest.raises(InputError, match=r"or a capture or recording in data_root; received 'towl' \(did you mean 'towel'"):
        benchmark(tmp_path, scenarios=["towl"], data_root=str(tmp_path))


def record(root, cable, train, evaluation):
    """Files of a cable as DEFORM's data set has them: training recordings 3, 6, 9, ... and evaluation recordings 1, 2, ..."""
    for part, numbers in (("train", range(3, 3 * train + 1, 3)), ("eval", range(1, evaluation + 1))):
        (root / cable / part).mkdir(parents=True, exist_ok=True)
        for number in numbers:
            (root / cable / part / f"{number}.pkl").touch()


def test_a_recording_in_data_root_is_a_scenario_by_its_name(tmp_path):
    record(tmp_path, "DLO7", 4, 1)
    given = {"scenarios": ["DLO7_train_12"], "data_root": str(tmp_path), "mocap": {"rings": 20}}
    made = benchmark(tmp_path, **given, transfers={"DLO7_train_12": ["DLO7_eval_1"]})
    (one, other) = made.scenarios.values()
    assert (one.source, one.category, one.path, one.ground) == ("mocap", "DLO7", "DLO7/train/12.pkl", False)
    assert other.path == "DLO7/eval/1.pkl"
    assert made.data_path("DLO7_train_12") == tmp_path / "DLO7" / "train" / "12.pkl"
    with pytest.raises(InputError, match=r"scenario DLO7_train_13: its data must exist; received .*DLO7/train/13\.pkl"):
        benchmark(tmp_path, scenarios=["DLO7_train_13"], data_root=str(tmp_path))
    with pytest.raises(InputError, match="scenario DLO7_train_12: source mocap requires data_root"):
        benchmark(tmp_path, scenarios=["DLO7_train_12"])
    with pytest.raises(InputError, match=r"every entry must be a row of .*received 'DLO7_test_12'"):
        benchmark(tmp_path, scenarios=["DLO7_test_12"], data_root=str(tmp_path))


def test_deforms_benchmark_is_a_pool_of_evenly_spaced_recordings_per_cable(tmp_path):
    record(tmp_path, "DLO7", 10, 2)
    record(tmp_path, "DLO8", 3, 14)
    pooled(tmp_path)
    tables = {"method_table": "pooled.yaml", "methods": ["one"], "scenarios": [], "pools": None, "mocap": {"rings": 20}}

    def made(**deform):
        return pooled(tmp_path, **tables, deform=deform, data_root=str(tmp_path))

    found = made(cables=["DLO7", "DLO8"], clips=3)
    assert found.config.scenarios == ("DLO7_train_3", "DLO8_train_3")
    # In the order of numbers, not of text; both ends belong to it.
    assert found.pools["DLO7_train_3"] == ("DLO7_train_15", "DLO7_train_30")
    assert found.pools["DLO8_train_3"] == ("DLO8_train_6", "DLO8_train_9")
    assert found.transfers["DLO7_train_3"] == ("DLO7_eval_1", "DLO7_eval_2")
    assert len(found.transfers["DLO8_train_3"]) == 14
    assert found.applies("one", "DLO8_train_3")
    with pytest.raises(InputError, match=r"DLO8: at least 4 recordings.*received 3 and 14.*found: DLO7, DLO8"):
        made(cables=["DLO8"], clips=4)
    with pytest.raises(InputError, match=r"DLO9: at least 2 recordings.*received 0 and 0"):
        made(cables=["DLO9"], clips=2)
    with pytest.raises(InputError, match="configuration, deform: DEFORM's data require data_root"):
        pooled(tmp_path, **tables, deform={"cables": ["DLO7"]})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        *(({name: []}, f"configuration, {name}: at least one entry is required") for name in ("scenarios", "methods", "seeds")),
        ({"methods": ["ful"]}, r"every entry must be a row of methods\.yaml; received 'ful' \(did you mean 'full'\?\)"),
        ({"scenarios": ["nothing"]}, r"row of scenarios\.tsv, or a capture or recording in data_root; received 'nothing'.*cable"),
        ({"scenarios": ["cable"]}, "scenario cable: source mocap requires data_root"),
        ({"scenarios": ["cable"], "data_root": "/nowhere"}, "scenario cable: its data must exist; received /nowhere/cable.csv"),
        ({"method_table": "missing.yaml"}, "must be readable"),
        ({"search_table": "missing.yaml"}, "must be readable"),
        ({"device": "gpu"}, "device: input should be 'auto', 'cpu' or 'cuda'"),
        ({"results": "a{b}"}, "results: string should match pattern"),
        ({"search": {"variables": {"object_neighbors": {"low": 0, "high": 50}}}}, "object_neighbors: at least 2 is required"),
        ({"only": "category=ropes"}, "only: category must match one of toy; received 'ropes'"),
        ({"only": "method=neuspring"}, "only: method must match one of .*received 'neuspring'"),
        ({"only": "color=red"}, "terms scenario="),
        ({"only": "seed"}, "terms scenario="),
        (
            {"aims": [{"method": "long", "baseline": "full", "metric": "chanfer", "ratio": 0.9}]},
            r"aims, metric: must be an error of positions.*Known: chamfer",
        ),
        ({"transfers": {"rope": []}}, r"transfers\.rope: must be different other scenarios, received \[\]"),
        ({"transfers": {"rope": ["rope"]}}, r"transfers\.rope: must be different other"),
        ({"transfers": {"rope": ["cable", "cable"]}}, r"transfers\.rope: must be different other"),
        ({"transfers": {"rope": ["cable"]}}, "cable must be of the same object as rope: source toy.*; received source mocap"),
    ],
)
def test_a_benchmark_is_checked_before_any_job(values, message, tmp_path):
    with pytest.raises(InputError, match=message):
        benchmark(tmp_path, **values)


def test_a_capture_without_what_its_masks_are_made_of_is_named_before_any_job(tmp_path):
    def planned(backend):
        chosen = {"perception": {"segment": {"backend": backend}}}
        return benchmark(tmp_path, scenarios=["mine"], data_root=str(tmp_path), **chosen)

    with pytest.raises(InputError, match=r"perception\.segment\.backend: must be one of given, opencv, .*received magic"):
        planned("magic")
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError, match=r"mine: a capture must be a folder with capture\.json.*neuspring make-capture"):
        planned("opencv")
    write(tmp_path / "mine" / "capture.json", json.dumps(config.plain(describe(masks=False))))
    assert planned("opencv").scenarios
    with pytest.raises(InputError, match=r"segment\.backend requires mask in every frame.*neuspring annotate .*mine`"):
        planned("given")
    with pytest.raises(InputError, match=r"marks\.json: annotations of object and hands are required.*neuspring annotate .*mine`"):
        planned("marks")
    write(tmp_path / "mine" / "marks.json", '{"format": 1, "cameras": {}}')
    with pytest.raises(InputError, match="must contain annotations of camera 0"):
        planned("marks")
    write(tmp_path / "mine" / "capture.json", "{}")
    assert planned("given").scenarios, "damaged data fail the jobs of their scenario"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("search: uniform, fit: springs, settings: {horizont: 0}", "method bad, settings:.*horizont"),
        ("search: unifrom, fit: springs", r"searches\.yaml; received 'unifrom' .did you mean 'uniform'"),
        ("oracle: false", "one of search, model, mean_of is required, received none"),
        ("search: uniform, oracle: true", "an oracle must have a fit"),
        ("search: uniform, fit: field, oracle: true, settings: {selection: tail}", "and holds none back"),
        ("model: static, search: uniform", "is required, received search uniform, model static"),
        ("model: static, fit: field, pool: all", "fit, pool: only methods with a search may have these keys"),
        ("model: static, appearance: {}", "only models with their own splats"),
        ("mean_of: nobody", "mean_of: must be another method without mean_of"),
        ("mean_of: full, fit: field", "fit: only methods with a search may have these keys, not the mean of full"),
        ("model: static, settings: {epochs: 1}", r"model static has no settings; received \['epochs'\]"),
        ("model: spring_gauss", "model: must be one of static"),
    ],
)
def test_rows_that_cannot_be(row, message, tmp_path):
    write(tmp_path / "bad.yaml", f"bad: {{{row}, description: x}}\n")
    with pytest.raises(InputError, match=re.compile(message, re.DOTALL)):
        benchmark(tmp_path, method_table="bad.yaml", methods=["bad"])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("settings: {variables: {drag: {high: 0}}}", "search uniform, settings:.*drag"),
        ("released_quirks: {no_such: true}", "released_quirks:.*no_such: unknown"),
    ],
)
def test_searches_that_are_named_are_checked_and_no_others(row, message, tmp_path):
    write(tmp_path / "bad.yaml", f"uniform: {{clusters: 1, {row}, description: x}}\npieces: {{clusters: 5, description: x}}\n")
    with pytest.raises(InputError, match="(?s)" + message):
        benchmark(tmp_path, search_table="bad.yaml")
    assert benchmark(tmp_path, search_table="bad.yaml", methods=["ours"]).methods


def test_springs_may_not_start_beyond_their_clamp(tmp_path):
    """A search's own bounds count, and a method without a second stage has no clamp."""
    narrow = {"fit": {"stiffness_range": [0.0, 5e4]}}
    with pytest.raises(
        InputError, match=r"method full, fit\.stiffness_range: must contain .*0\.0, 100000\.0.*; received \[0\.0, 5"
    ):
        benchmark(tmp_path, **narrow)
    with pytest.raises(InputError, match=r"must contain .*; received \[1000\.0, 200000\.0\]"):
        benchmark(tmp_path, fit={"stiffness_range": [1000.0, 2e5]})
    benchmark(tmp_path, methods=["coarse"], **narrow)
    text = "uniform: {clusters: 1, description: x, settings: {variables: {stiffness: {high: 4.0e+4}}}}\n"
    write(tmp_path / "soft.yaml", text)
    benchmark(tmp_path, search_table="soft.yaml", **narrow)


def pooled(folder, **changes):
    """A method on the pool of a rope, and the same alone."""
    rows = "one: {search: uniform, fit: springs, pool: all, description: x}\nunseen: {extends: one}\n"
    write(folder / "pooled.yaml", f"{METHODS}{rows}mean: {{mean_of: unseen, description: x}}\n")
    toys = "".join(f"{name}\ttoy\trope\trope/lift/smooth\tfalse\ttrue\n" for name in ("a", "b", "c"))
    write(folder / "toys.tsv", HEADER + toys + "cloth\ttoy\tcloth\tcloth/lift/smooth\tfalse\ttrue\n")
    chosen = {"scenario_table": "toys.tsv", "method_table": "pooled.yaml", "pools": {"rope": ["a", "b", "c"]}}
    return benchmark(folder, **(chosen | {"scenarios": ["a"], "methods": ["full", "one"]} | changes))


def test_methods_on_a_pool_have_searches_and_fits_of_their_own(tmp_path):
    made = pooled(tmp_path)
    assert made.pools["a"] == ("b", "c")
    assert list(made.scenarios) == ["a", "b", "c"], "the others are observed too"
    assert list(made.searches) == ["uniform", "uniform-all"]
    graph = Graph(made)
    assert [graph.owners["fit"][name] for name in ("full", "one")] == ["full", "one"]
    jobs = {name: SimpleNamespace(scenario="a", method=name, seed=0) for name in made.methods}
    found = [graph.files(STAGES["fit"], "search", job) for job in jobs.values()]
    assert found == [[f"results/a/{name}/0/search.json"] for name in ("search-uniform", "search-uniform-all")]
    others = ["results/b/observations.npz", "results/c/observations.npz"]
    assert [graph.files(STAGES["fit"], "pool", job) for job in jobs.values()] == [[], others]
    searches = [SimpleNamespace(scenario="a", search=name, seed=0) for name in made.searches]
    assert [graph.files(STAGES["search"], "pool", job) for job in searches] == [[], others]
    assert [variant(graph, job).get("pool") for job in jobs.values()] == [None, "all"]
    assert variant(graph, jobs["one"])["clusters"] == 1


def variant(graph, job):
    found = graph.options(STAGES["score"], job)["variant"]
    return found


def test_a_new_stage_s_options_have_their_defaults_and_a_required_one_is_a_wildcard(tmp_path):
    @stage(output="{scenario}/{seed}/extent.json")
    def extent(observations: Before, run: Recorder, seed: int, quantile: float = 0.5) -> Written:
        raise AssertionError("not run")

    graph = Graph(benchmark(tmp_path))
    assert graph.options(extent, SimpleNamespace(scenario="rope", seed=3)) == {"seed": 3, "quantile": 0.5}
    with pytest.raises(AttributeError, match="seed"):
        graph.options(extent, SimpleNamespace(scenario="rope"))


def test_a_mean_reads_the_predictions_of_all_seeds_of_a_row(tmp_path):
    made = pooled(tmp_path, methods=["mean"], seeds=[0, 1], only="seed=1 method=mean")
    assert made.whole.methods == ("unseen", "mean"), "the row is run and shown too"
    graph, job = Graph(made), SimpleNamespace(scenario="a", method="mean", seed=1)
    assert [unit.name for unit in graph.runs()] == ["a/mean/1"]
    assert graph.files(STAGES["average"], "rollout", job) == [f"results/a/unseen/{seed}/rollout.json" for seed in (0, 1)]
    assert graph.files(STAGES["score"], "rollout", job) == ["results/a/mean/1/rollout.json"]
    assert variant(graph, job) == {"mean_of": "unseen"}
    alone = pooled(tmp_path, methods=["mean"], scenarios=["a", "cloth"])
    assert list(alone.whole_left_out["mean"]) == ["cloth"]
    filmed = shipped("synthetic") | {"extra_rows": {"ours": "config/rows/ours.yaml"}, "methods": ["model_b_wide_mean"]}
    assert Graph(Benchmark(filmed, ROOT)).runs(), "masks are of cameras, not of seeds"


def test_scenarios_without_a_pool_are_left_out_of_its_methods(tmp_path):
    made = pooled(tmp_path, scenarios=["a", "cloth"], seeds=[0, 1, 2], twins_per_launch=8)
    assert made.whole_left_out == {"one": {"cloth": "it learns from a pool of recordings, and this scenario has no pool"}}
    names = [unit.name for unit in Graph(made).runs()]
    assert [name for name in names if "cloth" in name] == [f"cloth/full/{seed}" for seed in range(3)]
    assert made.applies("one", "a")
    alone = pooled(tmp_path, methods=["full"])
    assert (alone.pools, list(alone.scenarios)) == ({}, ["a"]), "no pool is asked for without such a method"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pools": None, "methods": ["one"]}, r"at least one method must apply to a scenario.* a pool requires `pools`"),
        ({"pools": {"more": ["b", "c"]}, "methods": ["one"]}, r"at least one method must apply"),
        ({"pools": {"rope": ["a"]}}, r"pools: each pool must have at least two scenarios"),
        ({"pools": {"rope": ["a", "b"], "more": ["a", "c"]}}, r"no scenario may be in two pools"),
        ({"pools": {"rope": ["a", "nobody"]}}, r"configuration, pools: every entry must be a row of toys\.tsv"),
        ({"pools": {"rope": ["a", "cloth"]}}, r"configuration, pools: cloth must be of the same object as a"),
    ],
)
def test_pools_that_cannot_be(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        pooled(tmp_path, **changes)


STUDIES = {
    "demo": ("", "baselines", "perception", "perception clean_depth", "heldout"),
    "toy": ("", "clusters", "paper", "tune"),
    "synthetic": ("", "paper", "headline"),
    "mocap": ("", "baselines", "clusters", "mocap_heldout", "mocap_heldout headline", "paper"),
    "deform": ("",),
    "film22": ("",),
    "phystwin": ("", "tune"),
}
"""Files of config/studies that are laid over a file of config/data."""


@pytest.mark.parametrize(
    ("data", "studies"),
    [(data, text) for data, texts in STUDIES.items() for text in texts],
)
def test_every_configuration_that_is_shipped_is_valid(data, studies, tmp_path):
    values = shipped(data, *studies.split())
    for row in read_scenarios(ROOT / "config" / "scenarios.tsv").values():
        needed = [tmp_path / row.path / file for file in SOURCES[row.source].needed] or [tmp_path / row.path]
        for path in needed if row.source not in ("capture", "synthetic", "toy") else ():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text('{"train": [0, 5], "test": [5, 9]}')
    for name in values["scenarios"] if data == "film22" else ():
        paint(tmp_path / name, frames=5)
    for cable in values.get("deform", {}).get("cables", ()):
        record(tmp_path, cable, 56, 14)
    values |= {"data_root": str(tmp_path)}
    for row in scenario_rows(config.parse(Config, values, "shipped").expanded()).values():
        if row.source == "mocap":
            (tmp_path / row.path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / row.path).touch()
    benchmark = Benchmark(values, ROOT)
    assert benchmark.compared_with in benchmark.methods
    assert set(Graph(benchmark).owners["fit"]) >= {name for name, row in benchmark.methods.items() if row.fit}


def test_a_plan_reads_the_small_files_of_cases_and_says_which_large_ones_exist(tmp_path):
    names = ["single_lift_sloth", "double_lift_sloth", "single_lift_rope"]
    values = {**shipped("phystwin"), "scenarios": names, "data_root": str(tmp_path)}
    for name in names:
        folder = tmp_path / "data" / "different_types" / name
        folder.mkdir(parents=True)
        write(folder / "final_data.pkl", "a text")
        write(folder / "split.json", "{}")

    def planned():
        graph = Graph(Benchmark(values, ROOT, plan_only=True))
        return plan.summary(graph, graph.runs(), [], gpus=["0"], cores=1, cluster=False)

    with pytest.raises(InputError, match=r"3 of 3 scenarios must exist.*split\.json: train: whole numbers .*received \{\}"):
        Benchmark(values, ROOT)
    assert "missing  single_lift_sloth, double_lift_sloth, single_lift_rope: the data of 3 of 3" in planned()
    for name in names:
        write(folder.parent / name / "split.json", '{"train": [0, 5], "test": [5, 9]}')
    write(folder / "metadata.json", '{"fps": "fast"}')
    assert re.search(r"missing  \S+single_lift_rope/metadata\.json: fps or record_hz: a positive number", planned())
    (folder.parent / names[0] / "final_data.pkl").unlink()
    assert "missing  single_lift_sloth, single_lift_rope: the data of 2 of 3 scenarios must exist" in planned()
    (folder / "metadata.json").unlink()
    assert "data     final_data.pkl exists for 2 scenarios; its content is not checked yet" in planned()


EXTRA = sorted((ROOT / "config" / "rows").glob("*.yaml"))
EXTRA_ROWS = {"extra_rows": {path.stem: str(path) for path in EXTRA}}


def shipped(data, *studies):
    """Settings that the workflow reads from config/config.yaml, a file of config/data and files of config/studies."""
    values = {}
    for name in ("config", f"data/{data}", *(f"studies/{study}" for study in studies)):
        config.merge(values, config.read_yaml(ROOT / "config" / f"{name}.yaml"))
    return values


def test_the_default_configuration_names_the_tables_alone():
    default = config.read_yaml(ROOT / "config" / "config.yaml")
    assert set(default) == {"scenario_table", "method_table", "search_table", "study_table"}
    assert config.parse(config.Config, default, "config.yaml") == config.Config()
    with pytest.raises(InputError, match=r"--configfile config/data/demo\.yaml"):
        Benchmark(default, ROOT)


def test_the_whole_benchmark_has_every_method_and_study_of_the_paper(tmp_path):
    whole, paper = shipped("phystwin"), config.read_yaml(ROOT / "config" / "studies" / "paper.yaml")
    assert {name: whole[name] for name in paper} == paper
    assert list(read_studies(ROOT / "config" / "studies.yaml")) == paper["studies"]
    rows = read_scenarios(ROOT / "config" / "scenarios.tsv").values()
    released = [row for row in rows if row.source == "phystwin"]
    assert {row.scenario for row in released} == set(whole["scenarios"])
    assert (len(released), sum(row.self_collision for row in released)) == (22, 9)
    assert {row.category for row in released} == {"cloth", "rope", "package", "zebra", "sloth", "dinosaur"}


def test_studies_bring_the_methods_of_their_rows_in_the_order_of_the_table():
    studies, methods = config.read_yaml(ROOT / "config" / "studies.yaml"), tables.read_methods(ROOT / "config" / "methods.yaml")
    made = Benchmark(shipped("toy", "paper"), ROOT).whole.methods
    named = {method for name in shipped("toy", "paper")["studies"] for method in studies[name]["rows"].values()}
    listed = set(shipped("toy", "paper")["methods"])
    assert made == tuple(name for name in methods if name in named | listed)
    # Methods that are all listed keep the order in which they are listed.
    some = shipped("toy") | {"studies": ["table3"], "methods": ["neuspring", "fixed_resolution", "no_triplane"]}
    assert Benchmark(some, ROOT).whole.methods == ("neuspring", "fixed_resolution", "no_triplane")
    assert Benchmark(some | {"methods": []}, ROOT).whole.methods == ("neuspring", "no_triplane", "fixed_resolution")


@pytest.mark.parametrize("overlays", [["synthetic"], ["synthetic", "paper"]], ids="-".join)
@pytest.mark.parametrize(
    ("study", "runs", "searches", "fits", "trainings"),
    [
        pytest.param("table1", 24, 12, 12, 12),
        ("table2", 24, 12, 24, 0),
        ("table2_ours", 24, 12, 24, 0),
        ("table3", 18, 6, 18, 0),
        ("clusters", 48, 48, 48, 0),
    ],
)
def test_a_target_of_a_table_means_its_rows_and_no_others_with_any_data(overlays, study, runs, searches, fits, trainings):
    """Two scenes and three seeds, whatever methods and studies the configuration names beside."""
    names = ["synthetic_single_lift_rope", "synthetic_single_lift_sloth"]
    values = shipped(*overlays) | {"scenarios": names, "transfers": None, "seeds": [0, 1, 2]}
    made = Benchmark(values | tables.for_targets(values, [study], ROOT), ROOT)
    graph = Graph(made)
    chosen = graph.runs(made.methods_of(study))
    units = {unit.rule + unit.name: unit.rule for run in chosen for unit in (run, *behind(run))}
    count = Counter(units.values())
    assert (count["run"], count["search"], count["fit"], count["train"]) == (runs, searches, fits, trainings)


def test_targets_leave_a_part_that_was_asked_for_and_other_targets_as_they_are():
    values = shipped("synthetic") | {"only": "seed=1 method=baseline"}
    part = Benchmark(values | tables.for_targets(values, ["table2"], ROOT), ROOT).config
    assert (part.methods, part.seeds) == (("baseline",), (1,))
    assert tables.for_targets(values, ["report"], ROOT) == tables.for_targets(values, [], ROOT) == {}
    assert tables.for_targets(shipped("toy"), ["table3", "report"], ROOT) == {"studies": ["table3"]}


def test_every_method_that_is_shipped_is_valid():
    methods = tables.read_methods(ROOT / "config" / "methods.yaml", EXTRA)
    values = config.read_yaml(ROOT / "config" / "data" / "demo.yaml") | {"methods": list(methods)} | EXTRA_ROWS
    made = Benchmark(values, ROOT)
    # No two rows are the same: each has a fit of its own, the oracle too. But one has as many regions as `clusters` says.
    owners = Graph(made).owners["fit"]
    assert {name: owner for name, owner in owners.items() if name != owner and name in made.methods} == {"clusters_5": "neuspring"}
    regions = {name: made.searches[row.searched].clusters for name, row in made.methods.items() if name.startswith("clusters_")}
    assert regions == {name: int(name.removeprefix("clusters_")) for name in regions}


def test_a_configuration_brings_rows_of_its_own(tmp_path):
    write(
        tmp_path / "rows.yaml", "methods: {mine: {extends: ours, description: x}}\nsearches: {small: {clusters: 1, description: x}}"
    )
    made = benchmark(tmp_path, extra_rows={"mine": "rows.yaml"}, methods=["ours", "mine"])
    assert made.methods["mine"].search == made.methods["ours"].search
    for text, message in (
        (
            "methods: {ours: {search: uniform, description: x}}",
            r"rows\.yaml, method ours: names of rows must differ; .*methods\.yaml",
        ),
        ("methods: {mine: {extends: none}}", r"rows\.yaml, method mine: extends: .*received none"),
        ("method: {mine: {}}", r"rows\.yaml: .*under methods, searches, studies; received method"),
        ("methods: [mine]", r"rows\.yaml: .*received methods"),
    ):
        write(tmp_path / "rows.yaml", text)
        with pytest.raises(InputError, match=message):
            benchmark(tmp_path, extra_rows={"mine": "rows.yaml"}, methods=["ours"])


def test_a_row_extends_another_and_each_stands_for_one_per_value(tmp_path):
    text = """
uniform: {clusters: 1, description: one, settings: {rollouts: 40, tied_rollouts: 2}}
more: {extends: uniform, description: more, settings: {rollouts: 80}}
most: {extends: more, settings: {tied_rollouts: 0}}
k{each}: {each: [2, 3], extends: uniform, clusters: "{each}", description: "{each} regions"}
key: {extends: k2, clusters: null}
"""
    rows = tables.read_searches(write(tmp_path / "searches.yaml", text), clusters=7)
    assert rows["most"] == config.SearchRow(clusters=1, description="more", settings={"rollouts": 80, "tied_rollouts": 0})
    assert rows["uniform"].settings == {"rollouts": 40, "tied_rollouts": 2}
    assert {name: (row.clusters, row.description) for name, row in rows.items() if name[0] == "k"} == {
        "k2": (2, "2 regions"),
        "k3": (3, "3 regions"),
        "key": (7, "2 regions"),
    }


@pytest.mark.parametrize(("values", "regions"), [({}, 5), ({"clusters": 3}, 3), ({"clusters": 7}, 7)])
def test_rows_that_name_no_number_of_regions_have_that_of_the_key(values, regions):
    names = ["model_b", "clusters_3", "neuspring"]
    made = Benchmark(shipped("toy") | {"methods": names} | values, ROOT)
    assert [made.searches[made.methods[name].searched].clusters for name in names] == [1, 3, regions]
    # Rows that do the same share search and fit.
    shared = {name: Graph(made).owners["fit"][name] for name in names}
    assert shared == {name: "neuspring" if regions == 3 and name == "clusters_3" else name for name in names}
    assert len(made.searches) == (2 if regions == 3 else 3)


def test_quirks_of_a_search_row_reach_its_search_and_its_fits_alone():
    values = {"scenarios": ["toy_rope_lift_smooth"], "methods": ["baseline", "phystwin_released"], "seeds": [0]}
    graph = Graph(Benchmark(values, ROOT))

    def settings(stage, **job):
        found = json.loads(
            graph.made_of(STAGES[stage], SimpleNamespace(scenario="toy_rope_lift_smooth", seed=0, **job))["settings"]
        )
        parse(Config, found, "what the command reads")
        return found

    for row, method, on in (("uniform", "baseline", False), ("released_quirks", "phystwin_released", True)):
        for found in (settings("search", search=row), settings("fit", method=method)):
            assert found["released_quirks"] == dict.fromkeys(config.plain(config.ReleasedQuirks()), on)
    fitted = settings("fit", method="phystwin_released")["fit"]
    assert (fitted["horizon"], fitted["learning_rate"]) == (1, 1e-3)
    runs = [SimpleNamespace(scenario=values["scenarios"][0], method=name, seed=0) for name in ("phystwin_released", "baseline")]
    assert variant(graph, runs[0])["released_quirks"] == sorted(config.plain(config.ReleasedQuirks()))
    assert "released_quirks" not in variant(graph, runs[1])


def test_the_released_rows_have_the_released_search():
    made = Benchmark({"scenarios": ["toy_rope_lift_smooth"], "methods": ["phystwin_released"]}, ROOT)
    for name, row in made.searches.items():
        search = tables.with_search(made.config, row, name).search
        variables = config.plain(search.variables)
        assert {one["scale"] for one in variables.values()} == {"linear"}
        assert (search.lengths, search.fixed) == ("meter", ())
        assert search.variables.stiffness == config.Variable(0.0, 1e5, 3e4)
        assert search.variables.object_radius.start == 0.02
    assert tables.with_search(made.config, made.searches["released_quirks"], "x").search.isolated_nodes == "allow"


# Own recordings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "methods"), [("capture", ("static", "controller_lbs", "ours")), ("synthetic", ("ours",)), ("toy", ("ours",))]
)
def test_methods_that_learn_nothing_stand_beside_on_own_recordings(source, methods):
    row = config.ScenarioRow(scenario="rope", source=source, category="rope", path="x", self_collision=False, ground=True)
    known = {name: Method(description="x", model="static") for name in ("static", "controller_lbs", "ours")}
    assert tables.with_references(load(""), {"rope": row}, known).methods == methods
    # A table without them has none, and none comes twice.
    assert tables.with_references(load(""), {"rope": row}, {"ours": known["ours"]}).methods == ("ours",)
    every = replace(load(""), methods=("ours", "static", "controller_lbs"))
    assert tables.with_references(every, {"rope": row}, known).methods == every.methods


def test_only_takes_a_part_by_scenario_category_method_and_seed():
    names = ["toy_rope_lift_smooth", "toy_rope_shake_smooth", "toy_cloth_lift_smooth"]
    all_of_it = {"scenarios": names, "methods": ["baseline", "clusters_2", "clusters_3"], "seeds": [0, 1, 2]}

    def chosen(only):
        part = Benchmark(config_with(all_of_it | {"only": only}), ROOT).config
        return part.scenarios, part.methods, part.seeds

    assert chosen("category=rope method=clusters_* seed=0,2") == (tuple(names[:2]), ("clusters_2", "clusters_3"), (0, 2))
    assert chosen("scenario=*_lift_* category=cloth")[0] == ("toy_cloth_lift_smooth",)
    assert chosen("")[0] == tuple(names)
    whole = Benchmark(config_with(all_of_it | {"only": "method=clusters_2 seed=1"}), ROOT).whole
    assert (len(whole.methods), whole.seeds) == (3, (0, 1, 2)), "tables are laid out for the whole"


# Oracles

NAMES = ["baseline", "neuspring", "oracle_neuspring"]
SCENES = ["toy_rope_lift_smooth", "toy_rope_shake_smooth"]


def oracles(**changes):
    values = config.read_yaml(ROOT / "config" / "data" / "toy.yaml") | {"methods": NAMES, "scenarios": SCENES, "studies": []}
    values |= EXTRA_ROWS
    return Benchmark(values | changes, ROOT)


def job(name):
    return SimpleNamespace(scenario=SCENES[0], method=name, seed=0)


def test_an_oracle_has_a_fit_of_its_own_is_named_in_its_record_and_is_not_transferred():
    made = oracles(seeds=[0, 1, 2], transfers={SCENES[0]: [SCENES[1]]})
    graph, fit = Graph(made), STAGES["fit"]
    assert graph.owners["fit"]["oracle_neuspring"] == "oracle_neuspring"
    assert [variant(graph, job(name)).get("oracle") for name in NAMES] == [None, None, True]
    plain = {"search": "uniform", "clusters": 1, "fit": "springs"}
    assert variant(graph, job("baseline")) == plain | made.methods["baseline"].settings
    # Settings and inputs are those of another row.
    ours, oracle = (graph.made_of(fit, job(name)) for name in ("neuspring", "oracle_neuspring"))
    assert oracle.pop("options") == ours.pop("options") | {"oracle": True} and oracle == ours
    moved = {unit.name.split("/")[1] for unit in graph.runs() if any(step.stage.name == "transfer" for step in unit.steps)}
    assert moved == {"baseline", "neuspring"}


def test_a_setting_that_every_method_sets_itself_is_refused():
    values = shipped("toy") | {"methods": ["neuspring", "search_only"], "fit": {"epochs": 3, "output_bound": 2.0}}
    with pytest.raises(InputError, match=r"fit\.output_bound: must have an effect.* received 2\.0 with neuspring\. Change it in"):
        Benchmark(values, ROOT)
