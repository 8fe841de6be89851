"""The report says what is on disk, whatever state that is in, and needs nothing else to be read."""

import re
from collections import Counter
from html.parser import HTMLParser
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.text import duration, program
from neuspring.draw.scene import chosen_frames
from neuspring.report.blocks import PageSection, Text
from neuspring.report.data import ReportSection, hours, rendered
from neuspring.report.gallery import write_gallery
from neuspring.report.page import REPORT_SECTIONS, Options, write
from neuspring.report.sections.pictures import PLAY_ADDRESS
from neuspring.report.sections.strip import around
from neuspring.report.sections.studies import answer
from neuspring.scores.numbers import Numbers, shown_names
from neuspring.scores.paper import Study
from neuspring.scores.runs import collect, collect_transfers
from tests.support import report_tree
from tests.support.browser import Browser, chromium
from tests.support.report_tree import page_section as section

WRITTEN = "2026-01-05T12:00:00+00:00"
NAMED = {"Baseline": "baseline", "Ours": "neuspring", "Later": "later"}
ABLATION = Study(title="Pieces", reference=None, baseline="Baseline", rows=NAMED)
SYSTEMS = Study(
    title="Systems",
    reference="table1_comparison",
    baseline="PhysTwin",
    rows={"Spring-Gaus": "spring_gaus", "GS-Dynamics": "gs_dynamics", "PhysTwin": "baseline", "NeuSpring": "neuspring"},
)
FILM_WIDTHS = """Promise.all([...document.querySelectorAll("video")].map(
  (film) => film.videoWidth || new Promise((done) => (film.onloadedmetadata = () => done(film.videoWidth)))
))"""
VOID = {"meta", "img", "br", "input", "link", "hr"}


def report(results: Path, **options) -> str:
    """The page of a results folder, as text."""
    values = {"studies": {"pieces": ABLATION, "systems": SYSTEMS}} | options
    return write(results, results / "report.html", Options(**values), WRITTEN).read_text()


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.fixture(scope="module")
def full(tmp_path_factory) -> Path:
    """Two scenarios, two methods, two seeds, with pictures, films, jobs, a tuning study and judged perception."""
    results = report_tree.make(tmp_path_factory.mktemp("report") / "results")
    report_tree.write_jobs(results, ["rope", "cloth"], ["baseline", "neuspring"], [0, 1], never=7)
    tune = results / "tune" / "rates"
    tune.mkdir(parents=True)
    table = "| setting | value |\n|---|---|\n| learning_rate | 0.001 |\n"
    (tune / "summary.md").write_text(f"# Rates\n\nBest trial 3.\n\n{table}\n<b>raw</b>\n")
    (results / "tables").mkdir()
    (results / "tables" / "perception.md").write_text("# Perception against the truth\n\n|a|b|\n|-|-|\n|1|2|\n")
    (results / "tables" / "scores.csv").write_text("scenario\n")
    found = collect(results, ["cloth", "rope"], ["baseline", "neuspring"], [0, 1])
    studies = {"systems": SYSTEMS}
    Numbers(everything=found, baseline="baseline", studies=studies, known_studies=studies, results=results).save(results)
    return results


@pytest.fixture(scope="module")
def page(full) -> str:
    return report(full)


@pytest.fixture
def small(tmp_path) -> Path:
    return report_tree.make(tmp_path / "results", pictures=False)


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Path:
    """Eight methods on one scenario."""
    methods = ["baseline", "neuspring", *(f"m{index}" for index in range(6))]
    return report_tree.make(tmp_path_factory.mktemp("report") / "results", ["rope"], methods, [0], pictures=False)


class Strict(HTMLParser):
    """Fails where tags do not close, ids repeat, or a picture has no words."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: Counter[str] = Counter()
        self.targets: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids[values.get("id")] += 1
        self.targets += [value for name, value in attrs if name in ("src", "href", "xlink:href", "poster", "srcset", "data")]
        assert tag != "img" or values.get("alt")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

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
    # The playground answers on the reader's own machine, and only where a link is followed.
    others = [target for target in parser.targets if not target.startswith(("#", "data:", f"{PLAY_ADDRESS}?frame="))]
    # Links to files beside the page, which are there.
    assert others and all((full / target).exists() for target in others)
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org/|127\.0\.0\.1:8080/\?frame=\d+&amp;scenario=\w+\")", page)


def test_pictures_lead_to_their_frames_in_the_player_and_a_command_opens_it(page, full):
    runs = " ".join(str(full / "rope" / method / "0") for method in ("baseline", "neuspring"))
    assert f'<pre tabindex="0" class="whole">{program("neuspring")} play {runs}</pre>' in page
    link = r'href="http://127\.0\.0\.1:8080/\?frame=(\d+)&amp;scenario=rope" target="player">frame \1</a>'
    frames = [int(frame) for frame in re.findall(link, page)]
    facts = Observations.load(full / "rope" / "observations.npz").scenario
    assert set(frames) == set(chosen_frames(facts, facts.frame_count))


def test_without_observations_pictures_lead_nowhere(tmp_path):
    results = report_tree.make(tmp_path / "results", ["rope"], ["baseline"], [0])
    (results / "rope" / "observations.npz").unlink()
    text = report(results)
    assert 'target="player"' not in text and "neuspring play" in text and "--training: " not in text


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_without_network_shows_all_of_it(page, full, width):
    with Browser() as browser:
        browser.open(full / "report.html", width)
        found = browser.check()
        assert found["width"] == width
        assert found["needed"] == width, found["outside"]
        assert found["outside"] == []
        assert (found["broken"], found["silent"]) == ([], 0)
        assert (found["errors"], found["loaded"], found["asked"]) == ([], [], [])
        # One seed of two scenarios and two methods, two films each; the first one's observed panel again.
        assert browser.run(FILM_WIDTHS) == [48] * 10


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
def test_the_browser_would_notice(tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        "<!doctype html><main><p style='width: 2000px'>wide</p><img alt='broken' src='data:image/png;base64,AA'>"
        "<img src='http://localhost:9/absent.png'><script>nothing()</script></main>"
    )
    with Browser() as browser:
        browser.open(page, 390)
        found = browser.check()
    assert found["needed"] > 390
    assert found["outside"]
    assert (found["broken"], found["silent"]) == (["broken", ""], 1)
    assert found["asked"] == ["http://localhost:9/absent.png"]
    assert any("nothing is not defined" in error for error in found["errors"])


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
def test_a_click_sorts_a_table_and_words_filter_it(many):
    report(many)
    table = "document.querySelector('#scores table.sortable')"
    rows = f"[...{table}.tBodies[0].rows]"
    values = f"{rows}.map((row) => +row.cells[1].dataset.value)"
    names = f"{rows}.filter((row) => !row.hidden).map((row) => row.cells[0].textContent)"
    with Browser() as browser:
        browser.open(many / "report.html", 1280)
        for order in (1, -1):
            browser.run(f"{table}.querySelectorAll('th button')[1].click()")
            found = browser.run(values)
            assert found == sorted(found)[::order]
            assert len(set(found)) == 8
        script = "(box => { box.value = 'NEU'; box.dispatchEvent(new Event('input')) })(document.querySelector('#scores input'))"
        browser.run(script)
        assert browser.run(names) == ["neuspring"]


def test_the_answer_comes_first_then_last_frames_scores_film_and_curves_and_the_rest_is_folded(page):
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles[:5] == ["Verdict", "Last frame", "Scores", "Film", "Curves"]
    assert titles[5:7] == ["How sure the scores are", "The paper&#39;s tables"]
    folded = re.findall(r'<details class="part"><summary><h2>(.*?)</h2>', page)
    assert folded == titles[5:]
    assert section(page, "verdict").startswith("Verdict Who wins No method is ahead (2 scenes, 2 seeds). The track error on future")


def test_a_study_is_shown_only_if_it_was_made(page):
    text = section(page, "studies")
    assert "systems: Systems" in text and "pieces: Pieces" not in text
    assert "Cannot be said: these are not the paper's data." in text
    assert "The data are not the paper's: synthetic (2 scenarios)." in text


def test_numbers_that_tables_kept_are_not_computed_again(tmp_path, monkeypatch):
    scenarios, methods = ["rope", "cloth", "bear"], ["baseline", "neuspring"]
    results = report_tree.make(tmp_path / "results", scenarios, pictures=False, curves=False)
    found = collect(results, scenarios, methods, [0, 1])
    studies = {"pieces": ABLATION, "systems": SYSTEMS}
    moved = collect_transfers(results, [], [], [])
    # One after the other, as targets of the workflow make them: what was made before stays.
    for name, study in studies.items():
        own = {name: study}
        Numbers(everything=found, baseline="baseline", studies=own, known_studies=own, transfers=moved).save(results)
    options = {"scenarios": scenarios, "methods": methods, "seeds": [0, 1], "baseline": "baseline"}
    page = report(results, **options)

    def never(*_):
        raise AssertionError("a bootstrap")

    for module in ("statistics", "study"):
        monkeypatch.setattr(f"neuspring.scores.{module}.resampled_means", never)
    assert report(results, **options) == page
    assert "pieces: Pieces" in section(page, "studies")
    seen = report_tree.observations("rope", "synthetic", 30)
    report_tree.write_run(results, seen, "baseline", 0, {}, curves=False, run_key="of another run")
    with pytest.raises(AssertionError, match="a bootstrap"):
        report(results, **options)


def test_a_package_adds_a_section_that_stands_where_it_says(monkeypatch, small):
    def hello(material):
        return PageSection(key="hello", title="Hello", blocks=[Text(text=f"{len(material.runs)} runs")])

    point = EntryPoint("hello", "package:section", "neuspring.report_sections")
    monkeypatch.setitem(vars(REPORT_SECTIONS), "_foreign", {"hello": point})
    monkeypatch.setattr(EntryPoint, "load", lambda _: ReportSection(order=15, make=hello))
    monkeypatch.setitem(vars(REPORT_SECTIONS), "_loaded", {})
    page = report(small)
    assert re.findall(r"<h2>(.*?)</h2>", page)[:3] == ["Verdict", "Hello", "Scores"]
    assert section(page, "hello") == "Hello 8 runs"


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
def test_one_control_moves_all_films_of_a_scenario(page, full):
    films = "[...document.querySelector('.films').querySelectorAll('video')]"
    boxes = "[...document.querySelectorAll('.films .panel')].slice(0, 3).map((one) => one.getBoundingClientRect())"
    slide = "(one => { one.value = 0.5; one.dispatchEvent(new Event('input')) })(document.querySelector('.control input'))"
    assert page.count('class="grid films fit"') == 4
    with Browser() as browser:
        browser.open(full / "report.html", 1280)
        # Observed once, then the predictions, in a row.
        browser.wait(f"{films}.length === 3 && {films}.every((film) => film.duration)")
        assert browser.run(f"new Set({boxes}.map((box) => box.top)).size") == 1
        assert browser.run("document.querySelectorAll('.control').length") == 4
        assert browser.run("document.querySelectorAll('.films video[controls]').length") == 0
        browser.run(slide)
        times = f"{films}.map((film) => film.currentTime.toFixed(3))"
        browser.wait(f"new Set({times}).size === 1 && +{times}[0] > 0.05 && {films}.every((film) => film.paused)")


@pytest.mark.parametrize(
    ("counts", "words", "tone"),
    [
        ({"within": 20, "better": 4}, "Reproduced: all 24 cells", "good"),
        ({"within": 20, "worse": 4}, "20 of 24 cells within the interval or better, 4 worse, 0 open.", "warn"),
        ({"within": 4, "worse": 20}, "4 of 24 cells", "bad"),
        ({"within": 12, "not run": 12}, "12 of 24 cells within the interval or better, 0 worse, 12 open.", "warn"),
        ({"not run": 24}, "Not run yet.", "mute"),
        ({"other data": 12, "not run": 12}, "Cannot be said: these are not the paper's data.", "mute"),
    ],
)
def test_an_answer_claims_no_more_than_its_cells(counts, words, tone):
    text, given = answer(Counter(counts), 24)
    assert text.startswith(words)
    assert given == tone


def test_an_empty_folder_says_so(tmp_path):
    assert f"Nothing to report yet: {tmp_path.name} holds no run" in section(report(tmp_path), "verdict")
    with pytest.raises(InputError, match="must exist"):
        write(tmp_path / "absent", tmp_path / "report.html", Options())


def test_runs_that_were_asked_for_and_are_not_there_are_missing(small):
    page = report(small, scenarios=["rope", "cloth", "zebra"], methods=["baseline", "neuspring", "later"], seeds=[0, 1])
    assert "10 of 18 runs have not finished." in section(page, "verdict")
    assert "later – – – – 0/6" in section(page, "scores")
    assert "zebra – – –" in section(page, "failures")
    assert "rope ✓ 2 ✓ 2 –" in section(page, "failures")


def test_damaged_files_are_listed_and_stop_nothing(tmp_path):
    results = report_tree.make(tmp_path / "results", seeds=(0, 1, 2))
    report_tree.write_jobs(results, ["rope"], ["baseline"], [0])
    broken = [
        *("rope/baseline/0/run.json", "rope/baseline/1/scores.parquet", "cloth/neuspring/0/history.parquet"),
        *("cloth/neuspring/0/trajectory.npz", "cloth/neuspring/0/plots/motion.png", "jobs/fit/rope/baseline/0/0.json"),
    ]
    for name in broken:
        damage(results / name)
    (results / "rope/neuspring/2/run.json").write_text('{"format": 1, "status": "ok"}')
    text = section(report(results), "failures")
    for name in broken:
        # The records that name them stand for parquet and npz files.
        place = name.replace("scores.parquet", "run.json").replace("trajectory.npz", "rollout.json")
        assert place in text, name
    assert "rope/neuspring/2/run.json" in text
    assert "Runs: 9 of 12 finished, 0 missing" in text


def test_failed_jobs_come_with_message_and_log(page):
    assert "CUDA error: out of memory" in section(page, "failures")
    assert re.search(r'href="jobs/fit/cloth/neuspring/\d/0\.log"', page)


def test_failed_runs_give_their_reason_as_text(small):
    seen = report_tree.observations("rope", "synthetic", 30)
    changes = {"status": "failed", "reason": "rollout: <script>alert(1)</script> diverged in frame 3"}
    report_tree.write_run(small, seen, "baseline", 0, {}, **changes)
    page = report(small)
    assert "<script>alert" not in page
    assert "rope baseline 0 rollout: <script>alert(1)</script> diverged in frame 3" in section(page, "failures")
    assert "rope 1 of 2 ✗ 1 ✓ 2" in section(page, "failures")
    assert "1 of 8 runs failed, first baseline on rope: rollout: <script>alert(1)" in section(page, "verdict")


def test_hours_are_those_of_all_jobs(small):
    report_tree.save_job(small, "fit/rope/baseline/0", seconds=5400.0)
    report_tree.save_job(small, "fit/rope/baseline/1", seconds=1800.0, failed=True)
    report_tree.save_job(small, "run/rope/baseline/0", seconds=3600.0, devices=[], device_names=[])
    text = section(report(small), "work")
    assert "fit 2 1 60.0 min 90.0 min 2.0" in text and "baseline 3 1" in text


def test_without_job_records_times_are_those_of_the_runs(small):
    text = section(report(small), "work")
    assert "There are no job records" in text and "Time and memory (medians) Method" in text and "baseline" in text


def test_curves_have_a_panel_per_scenario_and_are_told_in_words(page):
    labels = re.findall(r'<img src="data:image/svg[^>]* alt="([^"]*)" class="paper"', page)
    for title in ("Track error over time", "Search: best cost", "Fit: loss"):
        assert [label for label in labels if label.startswith(f"{title}, rope: ")]
        assert [label for label in labels if label.startswith(f"{title}, cloth: ")]


def test_the_same_folder_makes_the_same_page_but_for_its_date(full, page):
    again = write(full, full / "report.html", Options(studies={"pieces": ABLATION, "systems": SYSTEMS})).read_text()
    different = [line for line in again.splitlines() if line not in set(page.splitlines())]
    assert len(different) == 1
    assert "Written" in different[0]


@pytest.mark.slow
def test_a_page_keeps_to_its_size_and_says_what_it_leaves_out(full):
    none = report(full, megabytes=0.0)
    size = len(none.encode())
    assert size < 2_000_000
    assert 'href="cloth/baseline/0/video.mp4"' in none
    some = report(full, megabytes=(size + 30_000) / 1e6)
    assert size < len(some.encode()) < size + 40_000
    assert "not embedded, to keep this page small" in section(some, "pictures")
    silent = report(full, video_megabytes=0.0)
    assert "data:video" not in silent
    assert "data:image/webp" in silent


def test_big_pictures_are_made_smaller(full, page):
    widths = [int(width) for width in re.findall(r'<img src="data:image/webp[^>]* width="(\d+)"', page)]
    assert widths
    assert max(widths) <= 1200 < 1300


def test_tuning_studies_and_judged_perception_are_shown(page):
    text = section(page, "tuning")
    assert "Best trial 3." in text
    assert "learning_rate 0.001" in text
    assert "Perception against the truth" in section(page, "perception")


def test_markdown_brings_no_markup_of_its_own():
    made = str(rendered("<script>alert(1)</script> [x](javascript:alert(1)) ![p](https://host/p.png)"))
    assert "<script>" not in made
    assert "href" not in made
    assert "<img" not in made


def test_settings_that_differ_come_first_and_all_follow(small):
    settings = config.Config(scenarios=("rope",), methods=("baseline",), seeds=(0,), search=config.Search(rollouts=44))
    page = report(small, settings=settings)
    text = section(page, "setup")
    assert "search.rollouts 220 44" in text
    assert text.index("search.rollouts 220 44") < text.index("Full configuration")
    assert "fit.epochs 200" not in text
    assert "1 scenario, 1 method, seed 0" in page


def test_runs_of_several_commits_are_pointed_out(small):
    assert "All runs were made by commit 0123456789ab." in section(report(small), "setup")
    seen = report_tree.observations("rope", "synthetic", 30)
    report_tree.write_run(small, seen, "baseline", 0, {}, commit="fedcba9876543210-dirty")
    text = section(report(small), "setup")
    assert "Runs were made by 2 states of the code" in text
    assert "fedcba987654-dirty (1 run)" in text


def test_of_many_methods_six_are_drawn_and_the_page_says_which(many):
    assert "6 of 8 methods are drawn: baseline, neuspring, m0, m1, m2, m3." in section(report(many), "curves")
    assert "1 of 8 methods are drawn: m5." in section(report(many, shown=["m5"]), "curves")
    with pytest.raises(InputError, match="must be among the methods"):
        report(many, shown=["other"])


def test_the_gallery_links_every_video_with_its_scores(full, tmp_path):
    found = collect(full, ["rope", "cloth"], ["baseline", "neuspring"], [0, 1])
    numbers = Numbers(everything=found, baseline="baseline", names={"baseline": "PhysTwin (`baseline`)"})
    path = write_gallery(full, ["rope", "cloth", "zebra"], ["baseline", "neuspring"], 0, numbers, tmp_path / "tables")
    parser, page = Strict(), path.read_text()
    parser.feed(page)
    assert not parser.open
    files = [target for target in parser.targets if not target.startswith("#")]
    assert len([name for name in files if name.endswith(".mp4")]) == 8
    assert all((path.parent / name).is_file() for name in files)
    assert re.search(r"neuspring: training TE \d+\.\d+ mm, IoU \d+\.\d %; future TE", page)
    assert page.count("PhysTwin (<code>baseline</code>): training TE") == 2
    assert "No pictures: no images, or no finished run." in section(page, "zebra")


def test_last_frames_are_cut_to_what_they_show_in_the_proportions_of_the_film():
    first, second = np.zeros((2, 120, 3 * 200, 3), np.uint8)
    assert around([first, second]) == (slice(0, 120), slice(0, 200))
    first[50:60, 200 + 20 : 200 + 26] = 255  # predicted
    second[55:70, 400 + 30 : 400 + 44, 0] = 255  # observed elsewhere, as the difference shows
    second[0:40, 400 + 100 : 400 + 200] = 90  # a hand
    rows, columns = around([first, second])
    assert 0 <= rows.start <= 50 and 70 <= rows.stop <= 120 and 0 <= columns.start <= 20 and 44 <= columns.stop <= 200
    height, width = rows.stop - rows.start, columns.stop - columns.start
    assert height < 60 and width / height == pytest.approx(200 / 120, rel=0.05)


def test_methods_have_their_names_wherever_a_person_reads(full):
    names = shown_names(Path(__file__).resolve().parents[2] / "config" / "methods.yaml")
    assert names["search_only"] == "CMA-ES alone (`search_only`)" and names["clusters_4"] == "NeuSpring, 4 regions (`clusters_4`)"
    # A row does not take the name of the one that it extends.
    assert "PhysTwin (" not in names.get("model_a", "") and "springs_pooled" not in names
    page = report(full, names=names)
    for key in ("verdict", "strip", "scores", "pictures", "curves", "details", "failures"):
        text = section(page, key)
        assert "PhysTwin ( baseline )" in text and "NeuSpring ( neuspring )" in text, key
    assert shown_names(full / "absent.yaml") == {}


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize(("width", "most"), [(1400, 6000), (390, 9000)])
def test_a_page_of_three_scenes_and_three_methods_is_short_and_a_link_unfolds_a_section(tmp_path, width, most):
    names = [f"synthetic_single_lift_{name}" for name in ("rope", "cloth_1", "sloth")]
    results = report_tree.make(tmp_path / "results", names, ["search_only", "baseline", "neuspring"], [0])
    report(results, names=shown_names(Path(__file__).resolve().parents[2] / "config" / "methods.yaml"))
    with Browser() as browser:
        browser.open(results / "report.html", width)
        assert browser.run("document.documentElement.scrollHeight") < most
        if width == 1400:
            browser.run("document.querySelectorAll('#scores details').forEach((fold) => (fold.open = true))")
            tables = "[...document.querySelectorAll('#scores .scroll')].filter((one) => one.scrollWidth > one.clientWidth + 1)"
            assert browser.run(f"{tables}.map((one) => one.textContent)") == [], "no column is cut"
        fold = "document.querySelector('#details > details').open"
        assert not browser.run(fold)
        browser.run("location.hash = 'details'")
        browser.wait(fold)


def test_numbers_read_well():
    assert (duration(12.34), duration(600.0), duration(7200.0)) == ("12.3 s", "10.0 min", "2.0 h")
    assert (hours(0), hours(20), hours(1800), hours(7200), hours(1e6)) == ("0", "< 0.01", "0.50", "2.0", "278")
