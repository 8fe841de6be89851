"""`neuspring twin`: the order of its commands, what it passes over, what it refuses; steps leave what the real ones leave."""

import re
import sys
from pathlib import Path

import pytest

from neuspring.cli.main import main
from neuspring.core.files import write_table, write_text
from neuspring.core.run_folder import RunFolder
from neuspring.extensions.own_video import chain
from neuspring.extensions.own_video.options import Wish
from neuspring.scores import metrics
from tests.support import captures, played

NOTE = "note: hands within 5 cm: 0-2: 1, 3-4: 2: neuspring cut-capture x --frames 0-2 or --frames 3-4 --output ..."


class Steps:
    """Replaces processes: records the commands and writes their files."""

    def __init__(self):
        self.ran: list[list[str]] = []
        self.failing = ""
        self.said = "0 errors"

    def run(self, command, log):
        words = command[3:]
        self.ran.append(words)
        write_text(log, f"reason\n{self.said}\n")
        if self.failing in words:
            return 2
        place = Path(words[words.index("--output") + 1]) if "--output" in words else Path(words[1])
        if words[0] == "make-capture":
            captures.write(place, captures.describe(masks=False))
        elif words[0] == "mask":
            path = place / "capture.json"
            path.write_text(path.read_text().replace('"masks": false', '"masks": true'))
        elif words[0] == "cut-capture":
            captures.write(place)
        return 0

    @property
    def names(self):
        return [words[0] for words in self.ran]


@pytest.fixture
def steps(monkeypatch):
    one = Steps()
    monkeypatch.setattr(chain, "_run", one.run)
    monkeypatch.setattr(chain.TwinChain, "_tell", lambda self, scenario: print(f"told of {scenario.name}") or 0)
    return one


@pytest.fixture
def film(tmp_path):
    """A folder as a camera leaves it, and masks of another tool."""
    for name in ("color", "depth", "masks"):
        write_text(tmp_path / "my toy" / name / "0.png", "")
    write_text(tmp_path / "my toy" / "rig.json", "{}")
    return tmp_path / "my toy"


def twin(film, *words):
    return main(["twin", str(film), "--output", str(film.parent / "out"), *words])


def with_masks(film, *words):
    return twin(film, "--masks", str(film / "masks"), *words)


def test_the_commands_of_the_tutorial_run_in_their_order(film, steps, capsys):
    assert with_masks(film, "--mass", "0.3", "--intake=--pair order") == 0
    assert steps.names == ["make-capture", "mask", "check-data", "--snakefile"]
    color, depth = (f"--{name} {film / name}" for name in ("color", "depth"))
    lens, where = f"--rig {film / 'rig.json'}", f"--output {film.parent / 'out/captures/out'}"
    assert " ".join(steps.ran[0]) == (f"make-capture {color} {depth} {lens} --category object {where} --mass 0.3 --pair order")
    page = " ".join(steps.ran[-1])
    assert "config/data/own.yaml" in page and f"--directory {film.parent / 'out'}" in page
    assert 'scenarios=["out"]' in page and 'methods=["static", ' in page and "effort=quick" in page
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" ...")[0] for line in lines if line[0] == "["] == [
        f"[{index}/4] {name}" for index, name in enumerate(chain.TWIN_STEPS, start=1)
    ]
    assert sum(line.startswith(f"$ {sys.executable} -m ") for line in lines) == 4, "each can be run alone"
    assert lines[-1] == "told of out"


def test_a_second_call_does_what_is_left(film, steps, capsys):
    steps.failing = "check-data"
    assert with_masks(film) == 2
    error = capsys.readouterr().err
    log = film.parent / "out" / "logs" / "3_check.log"
    assert "Step check failed" in error and str(log) in error and "check-data" in error
    assert "reason" in log.read_text()
    steps.failing, steps.ran = "", []
    assert with_masks(film) == 0
    assert steps.names == ["check-data", "--snakefile"], "the workflow passes over what it has"
    steps.ran = []
    assert with_masks(film, "--mass", "2") == 2
    assert "the existing capture, made with no --mass; received --mass 2.0. Omit" in capsys.readouterr().err and not steps.ran


def test_a_second_call_takes_options_from_the_first(film, steps, capsys):
    assert with_masks(film, "--mass", "0.3", "--effort", "paper") == 0
    steps.ran = []
    assert twin(film, "--category", "object") == 0
    assert "effort=paper" in steps.ran[-1]
    assert f"--mass 0.3, --masks '{film / 'masks'}', --effort paper" in capsys.readouterr().out
    assert twin(film, "--effort", "quick", "--category", "rope") == 2
    assert "made with --category object; received --category rope" in capsys.readouterr().err


def test_the_longest_constant_grip_is_taken_or_another_window(film, steps, capsys, monkeypatch):
    steps.said = NOTE
    assert with_masks(film) == 0
    assert steps.names[:4] == ["make-capture", "mask", "check-data", "cut-capture"]
    assert 'scenarios=["out_0-2"]' in " ".join(steps.ran[-1]) and "learns from frames 0-2" in capsys.readouterr().out
    assert with_masks(film, "--window", "all") == 0
    assert 'scenarios=["out"]' in " ".join(steps.ran[-1])
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda text: "1-4")
    (film.parent / "out" / chain.STEPS_DONE).unlink()
    assert with_masks(film) == 0
    assert 'scenarios=["out_1-4"]' in " ".join(steps.ran[-1])


PAGE = """
import json, pathlib, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
path = pathlib.Path(sys.argv[-1]) / "capture.json"
if not {saves}: sys.exit(0)
part = path.with_suffix(".part")
part.write_text(path.read_text().replace('"masks": false', '"masks": true'))
part.replace(path)
time.sleep(60)
"""


@pytest.mark.parametrize("saves", [True, False])
def test_the_page_is_served_until_masks_are_saved(saves, film, steps, capsys, monkeypatch):
    """A process stands for the page: it saves and goes on serving, or ends without."""
    real = chain._neuspring
    page = [sys.executable, "-c", PAGE.format(saves=saves)]
    monkeypatch.setattr(chain, "_neuspring", lambda *words: [*page, words[1]] if words[0] == "annotate" else real(*words))
    monkeypatch.setattr(chain, "LOOK_FOR_MASKS", 0.05)
    monkeypatch.setattr(chain, "GRACE", 0.0)
    assert twin(film) == (0 if saves else 2)
    assert ("--snakefile" in steps.names) == saves
    assert ("the annotation page ended before masks were saved" in capsys.readouterr().err) == (not saves)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mass", "0"], "--mass: must be a positive number of kg; received 0"),
        (["--mass", "-1"], "--mass: must be a positive number of kg; received -1"),
        (["--window", "12"], "--window: must be a first and a last frame"),
        (["--masks", "/nowhere"], "paths of --masks, --hands and --marks must exist"),
    ],
)
def test_bad_input_costs_nothing(words, message, film, steps, capsys):
    assert twin(film, *words) == 2
    assert message in capsys.readouterr().err
    assert not steps.ran and not (film.parent / "out").exists()


def test_an_effort_that_is_none_and_a_film_that_is_not_there(film, steps, capsys):
    with pytest.raises(SystemExit) as ended:
        twin(film, "--effort", "huge")
    assert ended.value.code == 2 and "huge" in capsys.readouterr().err
    assert twin(film / "nothing") == 2
    assert "no such path" in capsys.readouterr().err and not steps.ran


def test_a_capture_is_taken_as_it_is(tmp_path, steps, capsys):
    made = captures.write(tmp_path / "here" / "thing")
    assert twin(made.folder) == 0
    assert steps.names == ["check-data", "--snakefile"]
    assert f"data_root={tmp_path / 'here'}" in steps.ran[-1]
    assert twin(made.folder, "--mass", "0.3") == 2
    assert 'Set "mass" in capture.json' in capsys.readouterr().err


def test_the_end_names_errors_beside_static_the_page_and_how_to_play(tmp_path, capsys):
    scenario = played.results(tmp_path / "out" / "results", ("static", "neuspring"))
    for method in ("static", "neuspring"):
        run = RunFolder.of(scenario / method / "0")
        write_table(metrics.score(run.trajectory, run.observations, method, 0), run.folder / "scores.parquet")
    write_text(tmp_path / "out" / "results" / "tables" / "report.html", "")
    whole = chain.TwinChain(Wish(film=tmp_path, output=tmp_path / "out", method="neuspring"))
    assert whole._tell(scenario) == 0
    twin, first, *rows, page, play = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"Twin: \d+ nodes, [\d,]+ springs", twin)
    assert first == "Errors in mm, future frames (training frames):" and [row.split()[0] for row in rows] == ["static", "neuspring"]
    value = 1000 * run.scores.set_index(["task", "metric"])["value"]["future", "chamfer"]
    assert f"chamfer {value:.1f} (" in rows[1]
    assert page.endswith("tables/report.html") and play.endswith(f"neuspring play {scenario / 'neuspring' / '0'}")
