"""The report shows what is on disk, in any state, and is self-contained."""

import re
from collections import Counter
from html.parser import HTMLParser
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from neuspring import config
from neuspring.core.errors import InputError
from neuspring.core.text import program
from neuspring.report.blocks import Text
from neuspring.report.data import ReportSection
from neuspring.report.page import REPORT_SECTIONS, Options, write
from neuspring.report.sections.strip import around
from neuspring.report.tables import shown_names
from neuspring.scores.paper import Study
from tests.support import report_tree
from tests.support.browser import Browser, chromium
from tests.support.report_tree import page_section as section

WRITTEN = "2026-01-05T12:00:00+00:00"
ROWS = {"Spring-Gaus": "spring_gaus", "GS-Dynamics": "gs_dynamics", "PhysTwin": "baseline", "NeuSpring": "neuspring"}
SYSTEMS = Study(title="Systems", reference="table1_comparison", baseline="PhysTwin", rows=ROWS)
NAMES = shown_names(Path(__file__).resolve().parents[2] / "config" / "methods.yaml")
needs_browser = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")


def report(results: Path, **options) -> str:
    """The page of a results folder, as text."""
    return write(results, results / "report.html", Options(**{"studies": {"systems": SYSTEMS}} | options), WRITTEN).read_text()


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """Two scenarios, two methods, two seeds, with pictures, films, jobs and judged perception."""
    results = report_tree.make(tmp_path_factory.mktemp("report") / "results")
    report_tree.write_jobs(results, ["rope", "cloth"], ["baseline", "neuspring"], [0, 1], never=7)
    (results / "tables").mkdir()
    (results / "tables" / "perception.md").write_text("# Perception\n")
    return results


@pytest.fixture(scope="module")
def page(full):
    return report(full, names=NAMES, settings=config.Config(studies=("systems",), search=config.Search(rollouts=44)))


@pytest.fixture
def small(tmp_path):
    return report_tree.make(tmp_path / "results", pictures=False)


class Strict(HTMLParser):
    """Fails where tags do not close or a picture has no words."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.ids: Counter[str] = Counter()
        self.targets: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids[values.get("id")] += 1
        self.targets += [value for name, value in attrs if name in ("src", "href", "xlink:href", "poster", "srcset", "data")]
        assert tag != "img" or values.get("alt")
        if tag not in {"meta", "img", "br", "input", "link", "hr"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, (tag, self.open[-3:])
        self.open.pop()


def test_the_page_holds_together_and_names_nothing_outside_itself(page, full):
    parser = Strict()
    parser.feed(page)
    assert not parser.open
    assert [name for name, count in parser.ids.items() if name and count > 1] == []
    inside = [target for target in parser.targets if target.startswith("#")]
    assert {target[1:] for target in inside} <= set(parser.ids)
    others = [target for target in parser.targets if not target.startswith(("#", "data:"))]
    assert others and all((full / target).exists() for target in others), "links to files beside the page, which are there"
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org/)", page)


def test_the_verdict_comes_first_then_last_frames_and_films_and_the_rest_is_folded(page, full):
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles[:4] == ["Verdict", "Last frame", "Videos", "Scores"]
    assert re.findall(r'<details class="part"><summary><h2>(.*?)</h2>', page) == titles[3:]
    rest = ["Scores", "The paper&#39;s tables", "Settings and versions", "Failures", "Time and memory", "Error and loss curves"]
    assert titles[3:] == rest
    text = section(page, "verdict")
    assert text.startswith(
        "Verdict No method is ahead (too few objects): the track error on future frames of NeuSpring ( neuspring ) is 0."
    )
    runs = " ".join(str(full / "rope" / method / "0") for method in ("baseline", "neuspring"))
    assert f'<pre tabindex="0" class="whole">{program("neuspring")} play {runs}</pre>' in page
    for key in ("verdict", "strip", "scores", "pictures", "failures", "work"):
        assert "PhysTwin ( baseline )" in section(page, key) or key in ("failures",), key
    assert "systems: Systems" in section(page, "studies") and "other data" in section(page, "studies")
    assert "search.rollouts 220 44" in section(page, "setup")
    assert f"{program('neuspring')} ui --results {full}" in section(page, "setup") and 'href="tables/perception.md"' in page
    assert "CUDA error: out of memory" in section(page, "failures") and re.search(
        r'href="jobs/fit/cloth/neuspring/\d/0\.log"', page
    )


@needs_browser
@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_without_network_shows_all_of_it_and_moves_films_in_step(page, full, width):
    films = "[...document.querySelector('.films').querySelectorAll('video')]"
    slide = "(one => { one.value = 0.5; one.dispatchEvent(new Event('input')) })(document.querySelector('.control input'))"
    with Browser() as browser:
        browser.open(full / "report.html", width)
        found = browser.check()
        assert (found["width"], found["needed"], found["outside"]) == (width, width, [])
        assert (found["broken"], found["silent"], found["errors"], found["loaded"], found["asked"]) == ([], 0, [], [], [])
        # Observed once, then the predictions.
        browser.wait(f"{films}.length === 3 && {films}.every((film) => film.duration)")
        browser.run(slide)
        times = f"{films}.map((film) => film.currentTime.toFixed(3))"
        browser.wait(f"new Set({times}).size === 1 && +{times}[0] > 0.05 && {films}.every((film) => film.paused)")


@needs_browser
def test_a_click_sorts_a_table_words_filter_it_and_a_link_unfolds_its_section(tmp_path):
    methods = ["baseline", "neuspring", *(f"m{index}" for index in range(6))]
    many = report_tree.make(tmp_path / "results", ["rope"], methods, [0], pictures=False)
    report(many)
    table = "document.querySelector('#scores table.sortable')"
    rows = f"[...{table}.tBodies[0].rows]"
    values = f"{rows}.map((row) => +row.cells[2].dataset.value)"
    with Browser() as browser:
        browser.open(many / "report.html", 1280)
        fold = "document.querySelector('#scores > details').open"
        assert not browser.run(fold)
        browser.run("location.hash = 'scores'")
        browser.wait(fold)
        for order in (1, -1):
            browser.run(f"{table}.querySelectorAll('th button')[2].click()")
            found = browser.run(values)
            assert found == sorted(found)[::order] and len(set(found)) == 8
        browser.run(
            "(box => { box.value = 'NEU'; box.dispatchEvent(new Event('input')) })(document.querySelector('#scores input'))"
        )
        assert browser.run(f"{rows}.filter((row) => !row.hidden).map((row) => row.cells[0].textContent)") == ["neuspring"]


def test_a_package_adds_a_section_that_stands_where_it_says(monkeypatch, small):
    def hello(material):
        return [Text(text=f"{len(material.runs)} runs")]

    point = EntryPoint("hello", "package:section", "neuspring.report_sections")
    monkeypatch.setitem(vars(REPORT_SECTIONS), "_foreign", {"hello": point})
    monkeypatch.setattr(EntryPoint, "load", lambda _: ReportSection(order=15, title="Hello", make=hello))
    monkeypatch.setitem(vars(REPORT_SECTIONS), "_loaded", {})
    made = report(small)
    assert re.findall(r"<h2>(.*?)</h2>", made)[:3] == ["Verdict", "Hello", "Scores"]
    assert section(made, "hello") == "Hello 8 runs"


def test_an_empty_folder_and_missing_runs_are_said(tmp_path, small):
    (tmp_path / "empty").mkdir()
    assert "Nothing to report yet: the folder empty contains no runs." in section(report(tmp_path / "empty"), "verdict")
    with pytest.raises(InputError, match="must exist"):
        write(tmp_path / "absent", tmp_path / "report.html", Options())
    with pytest.raises(InputError, match="must be among the methods"):
        report(small, shown=["other"])
    made = report(small, scenarios=["rope", "cloth", "zebra"], methods=["baseline", "neuspring", "later"], seeds=[0, 1])
    assert "later missing rope/0, rope/1, cloth/0, cloth/1, zebra/0, zebra/1" in section(made, "failures")


def test_damaged_files_are_listed_and_stop_nothing(tmp_path):
    results = report_tree.make(tmp_path / "results", seeds=(0, 1, 2))
    report_tree.write_jobs(results, ["rope"], ["baseline"], [0])
    broken = [
        *("rope/baseline/0/run.json", "rope/baseline/1/scores.parquet", "cloth/neuspring/0/history.parquet"),
        *("cloth/neuspring/0/trajectory.npz", "cloth/neuspring/0/plots/motion.png", "jobs/fit/rope/baseline/0/0.json"),
    ]
    for path in (results / name for name in broken):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    text = section(report(results), "failures")
    for name in broken:
        # The records that name them stand for parquet and npz files.
        assert name.replace("scores.parquet", "run.json").replace("trajectory.npz", "rollout.json") in text, name


def test_reasons_bring_no_markup_of_their_own(small):
    seen = report_tree.observations("rope", "synthetic", 30)
    changes = {"status": "failed", "reason": "rollout: <script>alert(1)</script> diverged", "commit": "fedcba9876543210-dirty"}
    report_tree.write_run(small, seen, "baseline", 0, {}, **changes)
    made = report(small)
    assert "<script>alert" not in made and "<script>alert(1)</script> diverged" in section(made, "failures")
    assert "0123456789ab (7 runs), fedcba987654-dirty (1 run)" in section(made, "setup")


def test_the_same_folder_makes_the_same_page_but_for_its_date(small):
    again = write(small, small / "report.html", Options(studies={"systems": SYSTEMS})).read_text()
    first = set(report(small).splitlines())
    different = [line for line in again.splitlines() if line not in first]
    assert len(different) == 1 and "Written" in different[0]


@pytest.mark.slow
def test_a_page_keeps_to_its_size_and_says_what_it_leaves_out(full):
    none = report(full, megabytes=0.0)
    size = len(none.encode())
    assert size < 2_000_000 and 'href="cloth/baseline/0/video.mp4"' in none
    some = report(full, megabytes=(size + 30_000) / 1e6)
    assert size < len(some.encode()) < size + 40_000
    assert "not embedded, to keep this page small" in section(some, "pictures")
    silent = report(full, video_megabytes=0.0)
    assert "data:video" not in silent and "data:image/webp" in silent


def test_last_frames_are_cut_to_what_they_show():
    methods = np.zeros((2, 3, 120, 200, 3), np.uint8)
    assert around(methods) == (slice(0, 120), slice(0, 200))
    methods[0, 1, 50:60, 20:26] = 255  # predicted
    methods[1, 2, 55:70, 30:44, 0] = 255  # observed elsewhere, as the difference shows
    methods[1, 2, 0:40, 100:200] = 90  # a controller
    assert around(methods) == (slice(46, 74), slice(16, 48))
