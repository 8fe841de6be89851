"""The parts: the marked tests, parity with the CPU, gsplat, and the benchmark."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from tests.gpu.chain import ROOT, Part

PARITY = {"simulator": 60, "rasterizer": 45, "skinning": 60, "spring_gaus": 45, "search": 60, "fit": 60}
"""Time limits of the comparisons with the CPU, s."""
TESTS, GSPLAT, BENCH = "tests", "gsplat", "bench"
NAMES = (*PARITY, TESTS, BENCH, GSPLAT)
"""In the order in which they run: what says most comes first, and gsplat, which may compile for minutes, last."""
BENCHMARK = "tests.benchmarks.bench"
BENCH_RESULTS = ROOT / "results/bench"
MARKED = re.compile(r"\bDEVICES\b|\bmark\.cuda\b")


def parts(device: str, folder: Path) -> list[Part]:
    """All parts for a device; what they write goes to `folder`."""
    comparisons = {name: _comparison(name, device, folder, limit) for name, limit in PARITY.items()}
    found = comparisons | {
        TESTS: _tests(device, folder),
        BENCH: _benchmark(device),
        GSPLAT: _comparison(GSPLAT, device, folder, 150),
    }
    return [found[name] for name in NAMES]


def _comparison(name: str, device: str, folder: Path, limit: float) -> Part:
    written = folder / f"{name}.found.json"
    return Part(
        name,
        [sys.executable, "-m", "tests.gpu.parity", name, device, str(written)],
        limit,
        lambda: json.loads(written.read_text(encoding="utf-8")),
        written,
    )


def marked_files() -> list[str]:
    """Test files with tests on devices. Others are not even read: they may need packages that a GPU machine lacks."""
    paths = sorted((ROOT / "tests").rglob("test_*.py"))
    return [path.relative_to(ROOT).as_posix() for path in paths if MARKED.search(path.read_text(encoding="utf-8"))]


def _tests(device: str, folder: Path) -> Part:
    written = folder / "tests.xml"
    chosen = ["-k", "cpu"] if device == "cpu" else ["-m", "cuda"]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *chosen, f"--junitxml={written}"]
    # pytest's status is 1 where tests failed, which the report says test by test.
    wrapped = "import subprocess, sys; status = subprocess.call(sys.argv[1:]); sys.exit(0 if status == 1 else status)"
    return Part(TESTS, [sys.executable, "-c", wrapped, *command, *marked_files()], 200, lambda: read_tests(written), written)


def read_tests(path: Path) -> dict[str, Any]:
    """Counts, skipped tests and failures of a JUnit report."""
    outcomes: dict[str, list[str]] = {"passed": [], "failed": [], "skipped": []}
    failures, reasons = [], []
    for case in ElementTree.parse(path).iter("testcase"):
        name = f"{case.get('classname')}::{case.get('name')}"
        fault = next((child for child in case if child.tag in ("failure", "error")), None)
        skip = case.find("skipped")
        if fault is not None:
            failures.append(f"{name}: {(fault.get('message') or '').splitlines()[:1]}")
        elif skip is not None:
            reasons.append(f"{name}: {skip.get('message')}")
        outcomes["failed" if fault is not None else "skipped" if skip is not None else "passed"].append(name)
    if not outcomes["passed"] and not failures:
        failures.append("no test ran")
    return {"facts": {outcome: len(names) for outcome, names in outcomes.items()}, "skipped": reasons, "failures": failures}


def _benchmark(device: str) -> Part:
    if importlib.util.find_spec(BENCHMARK) is None:
        reason = f"{BENCHMARK.replace('.', '/')}.py is not there"
        return Part(BENCH, [sys.executable, "-c", ""], 30, lambda: {"absent": reason})
    begin = time.time()
    # The whole table of a CPU takes longer than a part may.
    options = ["--device", device, *(["--quick"] if device == "cpu" else [])]
    return Part(BENCH, [sys.executable, "-m", BENCHMARK, *options], 240, lambda: read_benchmark(BENCH_RESULTS, begin))


def read_benchmark(folder: Path, begin: float) -> dict[str, Any]:
    """The files that the benchmark wrote since `begin` (Unix time), with what they hold."""
    files = [path for path in sorted(folder.rglob("*.json")) if path.stat().st_mtime >= begin]
    failures = [] if files else [f"no new file in {folder}"]
    held = {path.relative_to(folder).as_posix(): json.loads(path.read_text(encoding="utf-8")) for path in files}
    return {"facts": {"files": ", ".join(map(str, files))}, "failures": failures, "rows": held}
