"""`python -m tests.gpu`: its parts notice a device that computes something else, and its chain outlives each of them."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
import warp as wp

pytest.importorskip("neuspring.extensions.spring_gaus")

from tests.gpu import __main__ as command
from tests.gpu import parity
from tests.gpu.__main__ import main
from tests.gpu.chain import ABSENT, DONE, FAILED, Part, report, run
from tests.gpu.differences import largest, relative
from tests.gpu.parts import MARKED, NAMES, marked_files, parts, read_benchmark, read_tests

ROOT = Path(__file__).parents[1]
WRONG = 1.1
"""Factor of what a device in error answers: beyond every tolerance."""


def test_the_cpu_is_like_itself(tmp_path, capsys):
    quick = ["--device", "cpu", "--results", str(tmp_path)]
    assert main([*quick, "--parts", "skinning"]) == 0
    whole = json.loads((tmp_path / "gpu.json").read_text())
    (record,) = whole["parts"]
    assert record["outcome"] == DONE and not whole["failed"]
    found = record["result"]["differences"]
    assert len(found) >= 6 and all(d["found"] == 0 < d["allowed"] for d in found)
    assert "6 comparisons" in capsys.readouterr().out
    # The second run of the same code does not run it again.
    start = time.perf_counter()
    assert main([*quick, "--parts", "skinning"]) == 0
    assert time.perf_counter() - start < 2
    assert "kept" in capsys.readouterr().out


def test_without_a_gpu_it_says_what_to_do(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["--results", str(tmp_path)]) == 2
    said = capsys.readouterr().out
    assert "needs a GPU, its driver and a CUDA build of torch" in said and "--device cpu" in said
    # A driver older than Warp's CUDA: torch sees the GPU, Warp does not.
    monkeypatch.setattr(command, "resolve_device", lambda device: device)
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    assert main(["--results", str(tmp_path)]) == 2
    assert "Warp must find the GPU too" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def spoiled(answer):
    """An answer with every number in it wrong."""
    if isinstance(answer, dict):
        return {name: spoiled(value) for name, value in answer.items()}
    if isinstance(answer, tuple | list):
        return type(answer)(map(spoiled, answer))
    if isinstance(answer, np.ndarray | torch.Tensor):
        return answer * WRONG
    return answer


@pytest.mark.parametrize(
    ("part", "helper"),
    [
        ("simulator", "_frames"),
        ("simulator", "_frame_gradient"),
        ("rasterizer", "_picture"),
        ("skinning", "_carried"),
        ("spring_gaus", "roll_out_anchors"),
        ("spring_gaus", "_anchor_gradients"),
        ("search", "search"),
        ("fit", "fit"),
    ],
)
def test_a_device_that_computes_something_else_is_noticed(part, helper, monkeypatch):
    honest, calls = getattr(parity, helper), []

    def first_is_wrong(*arguments, **options):
        calls.append(arguments)
        answer = honest(*arguments, **options)
        if len(calls) % 2 == 0:
            return answer
        if helper == "search":
            return dataclasses.replace(answer, trace=answer.trace.assign(cost=answer.trace["cost"] * WRONG))
        if helper == "fit":
            return dataclasses.replace(answer, history=answer.history.assign(loss=answer.history["loss"] * WRONG))
        return spoiled(answer)

    monkeypatch.setattr(parity, helper, first_is_wrong)
    monkeypatch.setattr(parity, "NAMES", ("rope_lift", "cloth_selfcollision"))
    found = parity.PARTS[part]("cpu")["differences"]
    assert calls and not all(difference.ok for difference in found)
    monkeypatch.setattr(parity, helper, honest)
    if part != "simulator":  # long; `python -m tests.gpu --device cpu` has all
        assert all(difference.ok and difference.found == 0 for difference in parity.PARTS[part]("cpu")["differences"])


def test_gsplat_is_absent_without_cuda():
    assert parity.gsplat("cpu") == {parity.ABSENT: "gsplat needs CUDA, the device is cpu"}


def test_nan_and_other_shapes_are_no_agreement():
    assert not largest("x", "m", [np.nan], [0.0], 1.0).ok
    assert not relative("x", [np.inf, 1.0], [1.0, 1.0], 1.0).ok
    with pytest.raises(AssertionError, match="shape"):
        largest("x", "m", np.zeros((2, 3)), np.zeros(3), 1.0)


def script(name, code, *, limit=20.0, result=None):
    return Part(name, [sys.executable, "-c", code], limit, lambda: result if result is not None else {})


def differing(found):
    return {"differences": [largest("x", "m", [found], [0.0], 1.0).as_dict()]}


def test_the_chain_outlives_its_parts_and_keeps_what_they_said(tmp_path):
    child = tmp_path / "child"
    keep = f"open({str(child)!r}, 'w').write(str(process.pid))"
    hang = f"import subprocess; process = subprocess.Popen(['sleep', '60']); {keep}; process.wait()"
    chain = [
        script("crash", "print('before'); raise SystemExit(3)"),
        script("hang", hang, limit=2),
        script("beyond", "", result=differing(2.0)),
        script("nan", "", result=differing(float("nan"))),
        Part("unread", [sys.executable, "-c", ""], 20, lambda: json.loads("")),
        script("tests", "", result={"failures": ["test_x: wrong"]}),
        script("missing", "", result={"absent": "not installed"}),
        script("good", "", result=differing(0.5)),
    ]
    records = {record["part"]: record for record in run(chain, tmp_path, {"code": "1"}, 60)}
    outcomes = {name: record["outcome"] for name, record in records.items()}
    assert outcomes == dict.fromkeys(outcomes, FAILED) | {"missing": ABSENT, "good": DONE}
    assert records["crash"]["error"] == "exit status 3" and records["crash"]["output"] == ["before"]
    assert records["hang"]["error"] == "not finished after 2 s"
    started = int(child.read_text())
    assert not psutil.pid_exists(started) or psutil.Process(started).status() == psutil.STATUS_ZOMBIE
    assert records["beyond"]["error"] == "x: 2, allowed 1"
    assert "cannot be read" in records["unread"]["error"]
    assert records["tests"]["error"] == "test_x: wrong"
    assert json.loads((tmp_path / "beyond.json").read_text())["outcome"] == FAILED
    assert report(list(records.values())).count("<-- beyond") == 2


def test_what_is_done_is_kept_for_the_same_code_and_device(tmp_path):
    count = tmp_path / "count"
    count.touch()
    good = script("good", f"open({str(count)!r}, 'a').write('x')", result=differing(0.5))
    bad = script("bad", f"open({str(count)!r}, 'a').write('y')", result=differing(2.0))
    for key, again in (("1", False), ("1", False), ("2", False), ("2", True)):
        run([good, bad], tmp_path, {"code": key}, 60, again=again)
    assert count.read_text() == "xy" + "y" + "xy" + "xy"
    # Without time a part is not started; the next call goes on with it.
    (late,) = run([script("late", "")], tmp_path, {"code": "1"}, 0)
    assert late["outcome"] == FAILED and "run the command again" in late["error"]


def test_failures_and_skips_of_tests_are_read(tmp_path):
    (tmp_path / "test_three.py").write_text(
        "import pytest\ndef test_a(): pass\ndef test_b(): assert 1 == 2\n@pytest.mark.skip(reason='why')\ndef test_c(): pass\n"
    )
    written = tmp_path / "tests.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={written}", "--rootdir", "."]
    subprocess.run([*command, "test_three.py"], cwd=tmp_path, capture_output=True, check=False)
    read = read_tests(written)
    assert read["facts"] == {"passed": 1, "failed": 1, "skipped": 1}
    assert "test_b" in read["failures"][0] and "why" in read["skipped"][0]


def test_the_benchmark_must_write_something_new(tmp_path):
    (tmp_path / "old.json").write_text("{}")
    begin = time.time() + 5
    assert read_benchmark(tmp_path, begin)["failures"]
    (tmp_path / "new.json").write_text('{"rows": [1]}')
    os.utime(tmp_path / "new.json", (begin + 1, begin + 1))
    assert read_benchmark(tmp_path, begin)["rows"] == {"new.json": {"rows": [1]}}


def test_the_benchmark_is_a_short_one_on_a_cpu(tmp_path):
    on_cpu, on_gpu = ({part.name: part.command for part in parts(device, tmp_path)}["bench"] for device in ("cpu", "cuda:0"))
    assert on_cpu[-3:] == ["--device", "cpu", "--quick"] and on_gpu[-2:] == ["--device", "cuda:0"]


class Collected:
    """Plugin of pytest: names of the tests that it collects, and whether they are marked for a GPU."""

    def pytest_collection_finish(self, session):
        self.items = {item.nodeid: item.get_closest_marker("cuda") is not None for item in session.items}


def test_every_test_on_a_gpu_is_selected():
    for path in (ROOT / "tests").rglob("test_*.py"):
        text = path.read_text()
        if re.search(r"(if|not) torch\.cuda\.is_available\(\)", text):
            assert MARKED.search(text), f"{path}: what needs a GPU takes its device or its mark from tests/support/devices.py"
    listed = Collected()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        pytest.main(["--collect-only", "-qqs", "-p", "no:cacheprovider", "-p", "no:xdist", *marked_files()], plugins=[listed])
    marked = [name for name, on_gpu in listed.items.items() if on_gpu]
    assert len(marked) > 50 and not [name for name, on_gpu in listed.items.items() if "cuda:" in name and not on_gpu]
    assert {name.partition("::")[0] for name in marked} == set(marked_files())


def test_parts_fit_into_their_time(tmp_path):
    chain = parts("cpu", tmp_path)
    assert tuple(part.name for part in chain) == NAMES
    assert all(0 < part.limit < 300 for part in chain)
