"""Notes under tables of recordings that users filmed, and the findings of perception on the report page."""

from dataclasses import replace

import pandas as pd
import pytest
from neuspring.scores.runs import Collected

from neuspring.core.findings import finding, findings_as_facts
from neuspring.core.records import Recorder
from neuspring.report import page as report
from neuspring.report.notes import honest_notes
from tests.support.report_tree import make
from tests.support.runs import run_record

GOOD = {
    "search.result.springs": 100,
    "search.result.object_springs": 90,
    "fit.result.springs": 100,
    "fit.result.object_springs": 88,
    "fit.result.best_epoch": 7,
    "fit.result.at_bound": 0.0,
}


def collected(values: dict[str, float], params: dict[str, object], source: str = "capture") -> Collected:
    """One finished run per method with a future Chamfer distance, m."""
    rows = [
        {"scenario": "bear", "category": "toy", "method": method, "seed": 0, "task": "future", "metric": "chamfer", "value": value}
        for method, value in values.items()
    ]
    records = {
        ("bear", method, 0): run_record(scenario="bear", method=method, source=source, params=params if method == "ours" else {})
        for method in values
    }
    runs = pd.DataFrame(
        [{"scenario": "bear", "method": m, "seed": 0, "status": "ok", "notes": "", "source": source} for m in values]
    )
    return Collected(pd.DataFrame(rows).assign(unit="m", frames=10), runs, records=records)


def test_a_good_run_says_how_many_springs_hold_the_hands_and_nothing_else():
    assert honest_notes(collected({"static": 0.02, "ours": 0.01}, GOOD)) == ["bear / ours: 12 springs join the hands to the object"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"search.result.at_ends": "drag, object_radius"}, "the search ended at an end of its range in drag, object_radius"),
        ({"fit.result.at_bound": 0.25}, "fraction of the springs at the bound of their stiffness (fit.output_bound): 25 %"),
        ({"fit.result.best_epoch": 0}, "training improved nothing: the best epoch is the first"),
        ({"fit.result.object_springs": 100}, "no spring joins a hand to the object, so nothing moves it"),
    ],
)
def test_what_the_records_say_becomes_a_note(changes, text):
    notes = honest_notes(collected({"static": 0.02, "ours": 0.01}, GOOD | changes))
    assert any(note.startswith(f"bear / ours: {text}") for note in notes), notes


def test_a_method_no_better_than_static_is_named():
    notes = honest_notes(collected({"static": 0.0170, "controller_lbs": 0.03, "ours": 0.0171}, GOOD))
    assert notes[0] == "bear / ours: on future frames no better than static (CD 17.10 against 17.00 mm)"
    assert not any("controller_lbs" in note for note in notes)
    without = honest_notes(collected({"ours": 0.0171}, GOOD))
    assert without[0] == "bear: static has no scores, so nothing says whether a method learned anything"


def test_other_sources_have_no_such_notes():
    assert honest_notes(collected({"static": 0.01, "ours": 0.02}, GOOD, source="synthetic")) == []


def test_the_report_shows_findings_and_notes(tmp_path):
    results = make(tmp_path / "results", ["rope"], ["baseline", "ours"], [0], source="capture", pictures=False, curves=False)
    output = results / "report.html"
    assert "Findings of perception" not in report.write(results, output, report.Options()).read_text()
    recorder = Recorder("segment", results / "rope" / "perception" / "0" / "masks.json")
    recorder.output.parent.mkdir(parents=True)
    warning = finding("two objects", "warning", "camera 0", "2 pieces <far> apart", "one is expected", "Look at masks.png.")
    recorder.save(facts=findings_as_facts([warning, replace(warning, level="note", name="quiet")]))
    text = report.write(results, output, report.Options()).read_text()
    assert "Findings of perception" in text
    assert "2 pieces &lt;far&gt; apart; one is expected. Look at masks.png." in text
    assert "1 note" in text
    assert "rope: static has no scores, so nothing says whether a method learned anything" in text
