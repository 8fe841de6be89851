"""A study of clips: ours beside published numbers per cable, growth over time, films; with any part of cables and methods."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from neuspring.cli.main import main
from neuspring.config import parse
from neuspring.extensions.rods.clips import TAGS, ClipNumbers, published
from neuspring.report.blocks import markdown
from neuspring.scores.metrics import SCORE_COLUMNS
from neuspring.scores.paper import Study, read_studies
from tests.extensions.rods.clip_runs import FRAMES, RATE, write_transfer
from tests.support.study_runs import rows_of, tables_in, write_run

ROWS = Path(__file__).resolve().parents[3] / "config" / "rows" / "rods.yaml"
STUDY_TABLE = Path(__file__).resolve().parents[3] / "config" / "studies.yaml"
VALUES = {
    "title": "T",
    "reference": "deform_published",
    "kind": "clips",
    "baseline": "Rod",
    "training": "Choices were made on training clips",
    "rows": {"Field": "model_b_pooled", "Rod": "rod", "Residual": "rod_free"},
}
STUDY = parse(Study, VALUES, "here")
CLIPS = {"DLO3_eval_a": 0.002, "DLO3_eval_b": 0.006, "DLO3_eval_c": 0.004}


def found(results: Path, sources=("DLO3_train",), seeds=(0, 1)):
    return ClipNumbers(name="deform", study=STUDY, results=results, sources=sources, methods=list(STUDY.rows.values()), seeds=seeds)


def test_published_numbers_keep_their_digits_their_sources_and_what_the_tag_means():
    values = published()
    printed = values["DEFORM, best over the evaluation", "DLO4", "deform_l1"]
    assert (printed.text, printed.slack, printed.tag) == ("11.53", pytest.approx(0.005), "log")
    assert values["DEFORM", "DLO3", "deform_l1"].tag == "second-hand"
    assert {value.tag for value in values.values()} == set(TAGS)
    assert {cable for _, cable, _ in values} == {f"DLO{k}" for k in range(1, 6)}
    assert read_studies(STUDY_TABLE, [ROWS])["deform"].kind == "clips"


def test_ours_stand_beside_published_numbers_with_clips_seeds_and_time(tmp_path):
    for seed, factor in ((0, 1.0), (1, 1.5)):
        write_transfer(tmp_path, "DLO3", "rod", seed, {clip: factor * value for clip, value in CLIPS.items()})
    tables = tables_in(found(tmp_path).blocks())
    overview = rows_of(tables["L1 per cable"])
    # Seeds have 4 and 6 mm.
    assert overview["Rod"]["DLO3"].text == "5.00 ± 1.41" and overview["Rod"]["DLO3"].mark == "best"
    assert overview["DEFORM"]["DLO3"].text == "7.7†" and overview["DEFORM"]["DLO3"].mark == ""
    floor = overview["Floor: segments of constant length"]["DLO3"]
    assert floor.text == "0.42¶" and floor.mark == "", "it is no method"
    note = tables["L1 per cable"].note
    assert "evaluation clips (DLO3 3)" in note and STUDY.training in note and TAGS["second-hand"] in note
    detail = rows_of(tables["Ours in detail"])["DLO3"]
    texts = {name: cell.text for name, cell in detail.items()}
    assert (texts["Median clip"], texts["Worst clip"], texts["Worst"]) == ("5.00", "7.50", "DLO3_eval_b")
    assert (texts["Euclidean"], texts["Clips"], texts["Seeds"]) == ("15.00", "3/3", "2")


def test_minutes_are_those_of_search_and_fit(tmp_path):
    write_transfer(tmp_path, "DLO3", "rod", 0, CLIPS)
    path = write_run(tmp_path, "DLO3_train", "rod", 0, {})
    values = json.loads(path.read_text())
    values["timings"] = {"search": 30.0, "fit": 60.0, "score": 1000.0}
    path.write_text(json.dumps(values))
    assert found(tmp_path).cells.set_index("label").loc["Rod", "minutes"] == pytest.approx(1.5)


def test_a_mean_of_fewer_clips_is_marked_and_never_the_best(tmp_path):
    write_transfer(tmp_path, "DLO3", "rod", 0, CLIPS)
    fewer = dict.fromkeys(list(CLIPS)[:2], 0.001)
    write_transfer(tmp_path, "DLO3", "rod_free", 0, fewer, diverged=("DLO3_eval_c",))
    blocks = found(tmp_path).blocks()
    overview = rows_of(tables_in(blocks)["L1 per cable"])
    assert overview["Residual"]["DLO3"].text == "1.00 *" and overview["Residual"]["DLO3"].mark == ""
    assert overview["Rod"]["DLO3"].mark == "best"
    text = markdown(blocks)
    assert "Residual, DLO3_train / seed 0: diverged on DLO3_eval_c" in text and "Field: not run" in text


def test_the_command_writes_tables_growth_and_films(tmp_path, capsys, monkeypatch):
    results, output = tmp_path / "results", tmp_path / "tables"
    write_transfer(results, "DLO3", "rod", 0, CLIPS)
    write_transfer(results, "DLO3", "model_b_pooled", 0, {clip: 2 * value for clip, value in CLIPS.items()})
    output.mkdir()
    runs = ["--scenarios", "DLO3_train", "--methods", "rod", "model_b_pooled", "--seeds", "0"]
    command, known = (
        ["study", "--study", "deform", "--output", str(output)],
        ["--table", str(STUDY_TABLE), "--extra-rows", str(ROWS)],
    )
    kept = ["--output", str(results / "tables")]
    assert main(["tables", "--results", str(results), *runs, *kept]) == 0
    assert main([*command, *known, "--results", str(results)]) == 0
    names = ["deform.csv", "deform.md", "deform.tex"]
    names += ["deform_clips.csv", "deform_growth.png"]
    assert sorted(path.name for path in output.iterdir()) == names
    growth = found(results, seeds=[0]).growth
    rod = growth[growth["label"] == "Rod"]
    np.testing.assert_allclose(rod["seconds"], np.arange(FRAMES) / RATE)
    np.testing.assert_allclose(rod["euclid_mm"], [0.0, *[12.0] * (FRAMES - 1)])
    assert "\\begin{tabular}{@{}llr@{}}" in (output / "deform.tex").read_text(), "numbers, and no paragraphs"
    assert "7.7†" in capsys.readouterr().out
    pd.DataFrame(columns=list(SCORE_COLUMNS)).to_csv(tmp_path / "scores.csv")
    assert main([*command, *known, "--scores", str(tmp_path / "scores.csv")]) != 0
    assert "a study of the kind clips requires a results folder" in capsys.readouterr().err
