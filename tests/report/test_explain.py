"""A cell of a table can be followed to its runs, and says when they are no longer what it was made of."""

import io
import json
import re
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import pandas as pd
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.report.explain import explain, text
from neuspring.report.summary import write
from neuspring.scores import paper
from neuspring.scores.numbers import Numbers
from neuspring.scores.paper import read_studies
from neuspring.scores.runs import collect
from neuspring.scores.study import Verdict
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
    found = collect(folder, NAMES, METHODS, [0, 1])
    studies = {"table3": STUDIES["table3"]}
    write(Numbers(everything=found, baseline="fixed_resolution", studies=studies, known_studies=STUDIES), folder / "tables")


def of(results: Path, cell: str = "table3/NeuSpring/future/chamfer"):
    return explain(cell, results, results / "tables")


@pytest.mark.parametrize("metric", ["chamfer", "track_error", "iou", "lpips"])
def test_the_mean_of_the_runs_is_the_value_of_the_table(results, metric):
    found = of(results, f"table3/fixed_resolution/future/{metric}")
    runs = pd.DataFrame([(run.scenario, run.value) for run in found.runs], columns=["scenario", "value"])
    # Seeds first, then scenarios, as tables do; all scenarios have as many frames.
    mean = runs.groupby("scenario", sort=False)["value"].mean().mean()
    shown = 1e3 if metric in ("chamfer", "track_error") else 100.0 if metric == "iou" else 1.0
    assert found.row["ours"] == pytest.approx(shown * mean, rel=1e-12)
    assert found.row["change_low"] < found.row["change"] < found.row["change_high"]
    assert len(found.runs) == found.row["runs"] == 4
    assert found.problems == []


def test_runs_left_out_are_listed_with_their_reason(results):
    left = {(run.scenario, run.seed): run.why for run in of(results).left_out}
    assert left == {
        FAILED: "failed: rollout: it diverged",
        UNPAIRED: "not comparable, since without this scenario and seed: w/o AR (N=256) (missing)",
    }
    others = {(run.scenario, run.seed): run.why for run in of(results, "table3/fixed_resolution/future/cd").left_out}
    assert others[UNPAIRED].startswith("missing: no run.json")
    assert others[FAILED] == "not comparable, since without this scenario and seed: NeuSpring (failed)"


def test_a_run_comes_with_its_record(results):
    run = of(results).runs[0]
    record = json.loads(Path(run.record).read_text())
    assert (run.commit, run.device) == (record["commit"], record["device"]) == ("0123456789abcdef", "cpu")
    told = text(of(results))
    for part in (run.record, "verdict  partial (3 of 22)", "4 runs behind it", "Left out: 2"):
        assert part in told


def test_json_holds_everything(results):
    values = json.loads(of(results).as_json())
    assert values["cell"] == "table3/NeuSpring/future/chamfer"
    assert values["row"]["verdict"] in (Verdict.BETTER, Verdict.WORSE, Verdict.WITHIN) and values["row"]["partial"]
    assert (len(values["runs"]), len(values["left_out"]), values["problems"]) == (4, 2, [])


@pytest.mark.parametrize("name", ["NeuSpring/future/chamfer", "neuspring/future_prediction/cd", "NEUSPRING/Future/CD"])
def test_a_cell_may_be_named_in_any_case_and_as_the_paper_does(results, name):
    assert of(results, f"table3/{name}").cell == "table3/NeuSpring/future/chamfer"


@pytest.mark.parametrize("cell", ["table3/w/o TP/future/te", "table3/no_triplane/reconstruction/te"])
def test_labels_may_hold_a_slash(results, cell):
    found = of(results, cell)
    assert found.cell.startswith("table3/w/o TP/")
    assert (found.row["verdict"], found.runs) == (Verdict.NOT_RUN, [])


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("table9/NeuSpring/future/cd", "must name a study.*Did you mean table3"),
        ("table3/NeuSprong/future/cd", "must name a row.*Did you mean NeuSpring"),
        ("table3/NeuSpring/past/cd", "must name a task.*Known: reconstruction"),
        ("table3/NeuSpring/future/psnr", "must name a metric.*Known: cd, CD, chamfer"),
        ("table3/NeuSpring", "a number is METHOD/TASK/METRIC or STUDY/ROW/TASK/METRIC"),
    ],
)
def test_a_cell_that_there_is_not_is_refused_with_those_that_there_are(results, cell, message):
    with pytest.raises(InputError, match=message):
        of(results, cell)


def test_without_tables_it_says_how_to_make_them(tmp_path):
    with pytest.raises(InputError, match="Make them first"):
        explain("table1/NeuSpring/future/cd", tmp_path, tmp_path)


def damaged(path: Path) -> None:
    path.write_text(path.read_text()[:40])


def failed(path: Path) -> None:
    write_run(path.parents[3], NAMES[0], "neuspring", 0, {}, status="failed", reason="it diverged")


def another(path: Path) -> None:
    write_run(path.parents[3], NAMES[0], "neuspring", 0, all_scores(0.5))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (Path.unlink, "must be readable"),
        (damaged, "must be JSON"),
        (failed, "the run failed: it diverged"),
        (another, "another run"),
    ],
)
def test_a_record_that_is_missing_damaged_failed_or_new_is_a_problem(results, change, words):
    change(results / NAMES[0] / "neuspring" / "0" / "run.json")
    (problem,) = of(results).problems
    assert problem.startswith(f"{NAMES[0]} / seed 0: ") and words in problem
    assert told(results, "table3/NeuSpring/future/chamfer")[0] == 1
    assert of(results, "table3/fixed_resolution/future/cd").problems == []
    write_tables(results)
    assert of(results).problems == [], "the tables are of the runs that there are now"


def told(results: Path, *words: str) -> tuple[int, str]:
    """Exit status and output of the command."""
    with redirect_stdout(io.StringIO()) as stream:
        status = main(["explain", *words, "--results", str(results)])
    return status, stream.getvalue()


def test_a_number_of_the_summary_is_explained_without_any_study(results):
    status, words = told(results, "neuspring/future/TE")
    assert status == 0 and words.startswith("summary/neuspring/future/track_error (method neuspring)")
    means = Numbers.load(results / "tables").averages.set_index(["method", "task", "metric"])["equal"]
    assert f"ours     {1e3 * means['neuspring', 'future', 'track_error']:.2f} mm" in words
    assert "4 runs behind it" in words and "paper  " not in words


@pytest.mark.parametrize(
    "form", ["{name}/neuspring/0", "{name}/neuspring/0/", "{folder}/{name}/neuspring/0/run.json", "{name}", "neuspring"]
)
def test_a_run_is_explained_by_its_folder_scenario_or_method(results, form):
    status, words = told(results, form.format(name=NAMES[0], folder=results))
    assert status == (form == "neuspring"), "of that method a run failed"
    assert f"{NAMES[0]}/neuspring/0: ok" in words
    assert re.search(r"future: CD \d+\.\d\d mm, TE \d+\.\d\d mm", words) and "  fit: ok (fit.json)" in words
    assert (f"{NAMES[0]}/fixed_resolution/1: ok" in words) == (form == "{name}")
    assert (f"{NAMES[2]}/neuspring/1: ok" in words) == (form == "neuspring")


def test_a_run_without_the_record_of_a_stage_is_an_exit_status(results):
    (results / NAMES[0] / "neuspring" / "0" / "fit.json").unlink()
    status, words = told(results, f"{NAMES[0]}/neuspring/0")
    assert status == 1 and "fit.json" in words


def test_without_a_word_it_lists_what_can_be_explained_and_every_such_word_works(results, tmp_path, capsys):
    status, words = told(results)
    assert status == 0 and "A study: table3/ROW/TASK/METRIC" in words and f"A run: {NAMES[0]}/fixed_resolution/0" in words
    methods, tasks, metrics = (line.strip().split(" | ") for line in words.splitlines()[1:4])
    assert (methods, tasks) == (METHODS, ["reconstruction", "future"]) and "chamfer" in metrics
    assert told(results, f"{methods[0]}/{tasks[1]}/{metrics[0]}")[0] == 0
    assert main(["explain", "--results", str(tmp_path / "nothing")]) == 2
    assert main(["explain", "nobody", "--results", str(results)]) == 2
    assert "`neuspring explain` lists what there is" in capsys.readouterr().err
