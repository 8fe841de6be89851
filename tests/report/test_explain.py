"""A cell of a table can be followed to its runs, and says when they are no longer what they were."""

import io
import json
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring import config
from neuspring.cli.main import main
from neuspring.core.artifacts import Trajectory
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord, digest_file
from neuspring.core.run_record import RunRecord
from neuspring.report import explain as explain_text
from neuspring.report import study as tables_paper
from neuspring.report.benchmark import Benchmark, write
from neuspring.report.explain import check_files, departures, explain, rerun
from neuspring.scores import paper
from neuspring.scores.paper import read_studies
from neuspring.scores.runs import collect
from neuspring.stages.score import score
from tests.support import small
from tests.support.runs import STARTED, run_record
from tests.support.study_runs import all_scores, write_benchmark, write_run

STUDIES = read_studies(Path(__file__).resolve().parents[2] / "config" / "studies.yaml")
NAMES = sorted(paper.scenarios())[:3]
METHODS = ["fixed_resolution", "neuspring"]
FAILED, UNPAIRED = (NAMES[1], 1), (NAMES[2], 0)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Two methods on three scenarios and two seeds; one run failed, one of the other method is missing."""
    folder = tmp_path_factory.mktemp("template")
    write_benchmark(folder, NAMES, {"fixed_resolution": 1.0, "neuspring": 0.8})
    write_run(folder, FAILED[0], "neuspring", FAILED[1], {}, status="failed", reason="rollout: it diverged")
    (folder / UNPAIRED[0] / "fixed_resolution" / str(UNPAIRED[1]) / "run.json").unlink()
    write_tables(folder)
    return folder


@pytest.fixture
def results(tmp_path, template):
    return shutil.copytree(template, tmp_path / "results")


def write_tables(folder: Path) -> None:
    tables_paper.write_study("table3", STUDIES["table3"], folder, NAMES, [0, 1], METHODS, folder / "tables")


def of(results: Path, cell: str = "table3/NeuSpring/future/chamfer"):
    return explain(cell, results, results / "tables")


@pytest.mark.parametrize("metric", ["chamfer", "track_error", "iou", "lpips"])
def test_the_mean_of_the_runs_is_the_value_of_the_table(results, metric):
    found = of(results, f"table3/fixed_resolution/future/{metric}")
    table = pd.read_csv(results / "tables" / "table3.csv", dtype={"paper": str}, float_precision="round_trip")
    wanted = (table["method"] == "fixed_resolution") & (table["task"] == "future") & (table["metric"] == metric)
    (row,) = table[wanted].to_dict("records")
    runs = pd.DataFrame([(run.scenario, run.value, run.frames) for run in found.runs], columns=["scenario", "value", "frames"])
    # Seeds first, then scenarios, as tables do: the same sums in the same order have the same bits.
    means = runs.groupby("scenario", sort=False).mean()
    mean = means["value"].mean()
    if metric in ("iou", "lpips"):
        mean = (means["value"] * means["frames"]).sum() / means["frames"].sum()
    assert found.row["ours"] == row["ours"] == mean
    del row["study"]
    assert found.row == {name: None if pd.isna(value) else value for name, value in row.items()} | {"unit": found.row["unit"]}
    assert found.row["change_low"] < found.row["change"] < found.row["change_high"]
    assert len(found.runs) == row["runs"] == 4
    assert found.problems == []


def test_runs_left_out_are_listed_with_their_reason(results):
    left = {(run.scenario, run.seed): run.why for run in of(results).left_out}
    assert left == {
        FAILED: "failed: rollout: it diverged",
        UNPAIRED: "not comparable, since without this scenario and seed: w/o AR (N=256) (missing)",
    }
    others = {(run.scenario, run.seed): run.why for run in of(results, "table3/fixed/future/cd").left_out}
    assert others[UNPAIRED].startswith("missing: no run.json")
    assert others[FAILED] == "not comparable, since without this scenario and seed: NeuSpring (failed)"
    write_run(results, NAMES[0], "neuspring", 0, {("future", "chamfer"): 0.01})
    assert {run.why for run in of(results, "table3/NeuSpring/future/iou").left_out} >= {
        "no value of this metric (see the notes of its run)"
    }
    assert {run.why for run in of(results, "table3/fixed/future/iou").left_out} >= {
        "another method has no value of this metric here"
    }


def test_a_run_says_what_made_it(results):
    run = of(results).runs[0]
    record = json.loads(Path(run.record).read_text())
    assert run.facts["run_key"] == record["run_key"]
    assert run.facts["commit"] == "0123456789abcdef"
    assert run.facts["data_digest"] == digest_file(results / run.scenario / "observations.npz")
    assert run.settings == {"fit.fit.epochs": 7, "fit.kind": "springs"}
    text = explain_text.text(of(results))
    for part in (run.record, record["run_key"], "fit.fit.epochs: 7", "verdict  partial (3 of 22)", "Left out: 2", repr(run.value)):
        assert part in text


def test_the_command_names_the_run_and_its_stages(results):
    run = explain("table3/NeuSpring/future/chamfer", results, results / "tables", ["config/data/phystwin.yaml"]).runs[0]
    assert run.command == (
        f"snakemake {results}/{NAMES[0]}/neuspring/0/run.json --profile workflow/profiles/default --cores 1 "
        f"--configfile config/data/phystwin.yaml --config results={results} 'only=scenario={NAMES[0]} method=neuspring seed=0' "
        "device=cpu --forcerun fit score"
    )


def test_json_holds_everything(results):
    values = json.loads(of(results).as_json())
    assert values["cell"] == "table3/NeuSpring/future/chamfer"
    assert values["row"]["ours"] == values["in_table"]
    assert len(values["runs"]) == 4
    assert len(values["left_out"]) == 2
    assert values["problems"] == []


@pytest.mark.parametrize(
    "cell",
    [
        "table3/NeuSpring/future/chamfer",
        "table3/neuspring/future_prediction/cd",
        "Table/NEU/fut/CD",
        "t/neuspr/f/ch",
    ],
)
def test_a_cell_may_be_named_in_short_and_as_the_paper_does(results, cell):
    assert of(results, cell).cell == "table3/NeuSpring/future/chamfer"


@pytest.mark.parametrize("cell", ["table3/w/o TP/future/te", "table3/w/o T/future_prediction/track", "table3/no_t/rec/te"])
def test_labels_may_hold_a_slash(results, cell):
    found = of(results, cell)
    assert found.cell.startswith("table3/w/o TP/")
    assert found.row["verdict"] == "not run"
    assert found.runs == []
    assert "no_triplane was not among the methods of the benchmark." in explain_text.text(found)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("table9/NeuSpring/future/cd", "must name one study.*Did you mean table3"),
        ("table3/NeuSprong/future/cd", "must name one row.*Did you mean NeuSpring.*Known: w/o TP"),
        ("table3/w/future/cd", "must name one row; it could be w/o AR .*, w/o TP"),
        ("table3/NeuSpring/past/cd", "must name one task.*Known: reconstruction"),
        ("table3/NeuSpring/future/psnr", "must name one metric.*Known: cd, chamfer"),
        ("table3/NeuSpring", "a number is METHOD/TASK/METRIC or STUDY/ROW/TASK/METRIC.*Did you mean table3/NeuSpring/"),
        ("", "must name one study"),
    ],
)
def test_a_cell_that_there_is_not_is_refused_with_those_that_there_are(results, cell, message):
    with pytest.raises(InputError, match=message):
        of(results, cell)


def test_without_tables_it_says_how_to_make_them(tmp_path):
    with pytest.raises(InputError, match="Make them first"):
        explain("table1/NeuSpring/future/cd", tmp_path, tmp_path)


def test_a_twin_that_changed_is_reported(results):
    twin = results / NAMES[0] / "neuspring" / "0" / "twin.npz"
    twin.write_bytes(b"another twin")
    (problem,) = of(results).problems
    assert str(twin) in problem
    assert "received other content" in problem
    assert "1 not as recorded" in explain_text.text(of(results))
    assert of(results, "table3/fixed/future/cd").problems == []


def test_a_digest_that_changed_is_reported(results):
    """In the stage's record: the file no longer has it, and the run was made of another."""
    path = results / NAMES[0] / "neuspring" / "0" / "fit.json"
    record = StageRecord.load(path)
    path.write_text(path.read_text().replace(record.files["twin"][1], "0" * 64))
    problems = of(results).problems
    assert len(problems) == 2
    assert "other content" in problems[0]
    assert "its run_key is not that of its content" in problems[1]


def test_scores_that_changed_are_reported_as_an_older_table_too(results):
    write_run(results, NAMES[0], "neuspring", 0, all_scores(0.5))
    problems = of(results).problems
    assert len(problems) == 1
    assert "make it again" in problems[0]
    path = results / NAMES[0] / "neuspring" / "0" / "scores.parquet"
    table = pd.read_parquet(path)
    table.assign(value=table["value"] * 2).to_parquet(path)
    assert any("run_key" in problem for problem in of(results).problems)
    write_tables(results)
    assert not any("make it again" in problem for problem in of(results).problems)


def test_observations_and_records_that_changed_are_reported(results):
    (results / NAMES[0] / "observations.npz").write_bytes(b"other data")
    (results / NAMES[2] / "neuspring" / "1" / "fit.json").unlink()
    problems = "\n".join(of(results).problems)
    assert problems.count("other content than the run was scored on") == 2
    assert f"{NAMES[2]} / seed 1: " in problems


def test_settings_are_compared_with_the_defaults_of_their_section():
    settings = {
        "search": {"search": {"rollouts": 3, "variables": {"stiffness": {"start": 1e4}}}, "clusters": 5, "seed": 1},
        "render": {"margin": 123, "released_quirks": ["any_alpha"]},
    }
    assert departures(settings) == {
        "search.clusters": 5,
        "search.search.rollouts": 3,
        "search.search.variables.stiffness.start": 1e4,
        "render.margin": 123,
        "render.released_quirks": ["any_alpha"],
    }


def test_settings_of_a_baseline_are_compared_with_those_of_its_model():
    defaults = config.plain(config.Config())["baselines"]["spring_gaus"]
    settings = {"train": {"model": "spring_gaus", **defaults, "anchors": 7, "seed": 1}, "rollout": {"model": "spring_gaus"}}
    assert {name: value for name, value in departures(settings).items() if not name.endswith(".model")} == {"train.anchors": 7}


def test_the_command_names_the_rules_of_a_baseline():
    settings = {"train": {}, "rollout": {}, "render": {}}
    record = run_record(device="cuda:0", variant={"model": "gs_dynamics"}, settings=settings)
    assert rerun(Path("results"), "a", "gs", 0, record).endswith("--forcerun train predict render score")
    twin = run_record(device="cuda:0", variant={"search": "uniform"}, settings={"search": {}, "rollout": {}})
    assert rerun(Path("results"), "a", "m", 0, twin).endswith("--forcerun search rollout score")


def test_the_key_is_that_of_a_real_run(tmp_path):
    """`stages.score` and `check_files` take the key of the same things."""
    seen, folder = tmp_path / "small" / "observations.npz", tmp_path / "small" / "search_only" / "0"
    observations = small.observations()
    observations.save(seen)
    still = np.repeat(observations.nodes[None], observations.scenario.frame_count, axis=0)
    Trajectory(positions=still, frame_count=len(still)).save(folder / "trajectory.npz")
    named = {"trajectory": ["trajectory.npz", digest_file(folder / "trajectory.npz")]}
    records = {"search": folder / "search.json", "rollout": folder / "rollout.json"}
    StageRecord(stage="search", status="ok", settings={"seed": 0}, started=STARTED).save(records["search"])
    StageRecord(stage="rollout", status="ok", files=named, started=STARTED, inputs={"observations": digest_file(seen)}).save(
        records["rollout"]
    )
    score(observations=seen, **records, method="search_only", variant={"fit": "none"}, seed=0, output=folder / "run.json")
    record = RunRecord.load(folder / "run.json")
    assert check_files(folder / "run.json", record, seen) == (3, [])
    _, problems = check_files(folder / "run.json", replace(record, seed=1), seen)
    assert len(problems) == 1


@pytest.fixture
def done(results):
    """The tables of the benchmark beside those of a study, as a finished workflow leaves them."""
    found = collect(results, NAMES, METHODS, [0, 1])
    write(Benchmark(everything=found, baseline="fixed_resolution"), results / "tables")
    (results / "tables" / "studies").mkdir()
    for path in (results / "tables").glob("table3*"):
        path.rename(results / "tables" / "studies" / path.name)
    return results


def told(results: Path, *words: str) -> tuple[int, str]:
    """Exit status and output of the command."""
    with redirect_stdout(io.StringIO()) as stream:
        status = main(["explain", *words, "--results", str(results)])
    return status, stream.getvalue()


def test_a_number_of_the_summary_is_explained_without_any_study(done):
    shutil.rmtree(done / "tables" / "studies")
    status, text = told(done, "neuspring/future/TE")
    assert status == 0 and text.startswith("summary/neuspring/future/track_error (method neuspring)")
    means = pd.read_csv(done / "tables" / "averages.csv").set_index(["method", "task", "metric"])["equal"]
    assert f"ours     {1e3 * means['neuspring', 'future', 'track_error']:.2f} mm" in text
    assert "4 runs behind it" in text and "paper  " not in text and "0 not as recorded" not in text


@pytest.mark.parametrize(
    "form", ["{name}/neuspring/0", "{name}/neuspring/0/", "{folder}/{name}/neuspring/0/run.json", "{name}", "neuspring"]
)
def test_a_run_is_explained_by_its_folder_scenario_or_method(done, form):
    status, text = told(done, form.format(name=NAMES[0], folder=done))
    assert status == 0 and f"{NAMES[0]}/neuspring/0: ok" in text
    assert re.search(r"future: CD \d+\.\d\d mm, TE \d+\.\d\d mm", text) and "again: snakemake " in text
    assert (f"{NAMES[0]}/fixed_resolution/1: ok" in text) == (form == "{name}")
    assert (f"{NAMES[2]}/neuspring/1: ok" in text) == (form == "neuspring")


def test_a_run_that_changed_is_an_exit_status(done):
    (done / NAMES[0] / "neuspring" / "0" / "twin.npz").write_bytes(b"another twin")
    status, text = told(done, f"{NAMES[0]}/neuspring/0")
    assert status == 1 and "received other content" in text


def test_without_a_word_it_lists_what_can_be_explained_and_every_such_word_works(done, tmp_path, capsys):
    status, text = told(done)
    assert status == 0 and "A study: table3/ROW/TASK/METRIC" in text and f"A run: {NAMES[0]}/fixed_resolution/0" in text
    methods, tasks, metrics = (line.strip().split(" | ") for line in text.splitlines()[1:4])
    assert (methods, tasks) == (METHODS, ["reconstruction", "future"]) and "chamfer" in metrics
    assert told(done, f"{methods[0]}/{tasks[1]}/{metrics[0]}")[0] == 0
    assert main(["explain", "neus/fut", "--results", str(done)]) == 2
    assert "must be METHOD/TASK/METRIC, STUDY/ROW/TASK/METRIC, or a run that there is" in capsys.readouterr().err
    assert main(["explain", "--results", str(tmp_path / "nothing")]) == 2
    assert "a results folder with finished runs is required" in capsys.readouterr().err


def test_pictures_settings_are_compared_with_their_defaults():
    images = config.plain(config.Config())["images"]
    assert departures({"appearance": {"images": images}, "render": {"images": images | {"video": not images["video"]}}}) == {
        "render.images.video": not images["video"]
    }
