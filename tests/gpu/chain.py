"""Parts that run one after the other, each in a process of its own with a time limit, and what they leave behind.

A part's record is results/gpu/PART.json and its output PART.log. A part that is done is not run again on the same code and device.
A part that fails, hangs or takes the GPU down leaves its error and its output, and the next one goes on.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring.core.files import write_text

ROOT = Path(__file__).parents[2]
DONE, FAILED, ABSENT = "done", "failed", "absent"
"""Outcomes. An absent part needs something that is not there, which is no failure."""
LINES = 30
"""Of the output that a failed part's record keeps."""


@dataclass(frozen=True)
class Part:
    """One part of the chain."""

    name: str
    command: Sequence[str]
    """Exit status 0 where it ran, whatever it found."""
    limit: float
    """s."""
    read: Callable[[], dict[str, Any]]
    """What the command found, once it ran: `differences` (each with `ok`), `facts`, `failures` (words), or `absent` (why)."""
    writes: Path | None = None
    """What `read` reads. An earlier one is removed first, so that it cannot be taken for this one."""


def run(parts: Sequence[Part], folder: Path, key: dict[str, Any], seconds: float, *, again: bool = False) -> list[dict[str, Any]]:
    """The records of all parts, run within `seconds` or read from an earlier run with the same `key`."""
    folder.mkdir(parents=True, exist_ok=True)
    end, records = time.monotonic() + seconds, []
    for part in parts:
        record = None if again else _kept(folder / f"{part.name}.json", key)
        if record is None:
            record = _run(part, folder, min(part.limit, end - time.monotonic())) | {"key": key}
            write_text(folder / f"{part.name}.json", json.dumps(record, indent=1) + "\n")
        else:
            record["kept"] = True
        print(line(record), flush=True)
        records.append(record)
    return records


def _kept(path: Path, key: dict[str, Any]) -> dict[str, Any] | None:
    """The record of a part that is done; None if there is none for this key."""
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if record.get("key") == key and record.get("outcome") == DONE else None


def _run(part: Part, folder: Path, limit: float) -> dict[str, Any]:
    log = folder / f"{part.name}.log"
    record: dict[str, Any] = {"part": part.name, "command": list(part.command), "seconds": 0.0, "error": ""}
    if limit <= 0:
        return record | {"outcome": FAILED, "error": "no time was left; run the command again, it goes on here"}
    if part.writes:
        part.writes.unlink(missing_ok=True)
    start = time.monotonic()
    error = _execute(part.command, log, limit)
    record["seconds"] = round(time.monotonic() - start, 2)
    if not error:
        try:
            record["result"] = part.read()
        except Exception as fault:
            error = f"what it wrote cannot be read: {type(fault).__name__}: {fault}"
    if error:
        return record | {"outcome": FAILED, "error": error, "output": log.read_text(errors="replace").splitlines()[-LINES:]}
    result = record["result"]
    if result.get("absent"):
        return record | {"outcome": ABSENT, "error": result["absent"]}
    beyond = [f"{d['what']}: {d['found']:.3g}, allowed {d['allowed']:.3g}" for d in result.get("differences", []) if not d["ok"]]
    faults = [*result.get("failures", []), *beyond]
    return record | {"outcome": FAILED if faults else DONE, "error": "; ".join(faults)}


def _execute(command: Sequence[str], log: Path, limit: float) -> str:
    """Run a command with its output in `log`; returns what went wrong, empty if nothing did."""
    with log.open("w", encoding="utf-8") as output:
        # A session of its own, so that what it started ends with it.
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            status = process.wait(limit)
        except subprocess.TimeoutExpired:
            return f"not finished after {limit:.0f} s"
        finally:
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return "" if status == 0 else f"exit status {status}"


def digest() -> str:
    """Of the code that runs: the package, the tests and their golden data. It needs no git."""
    whole = hashlib.sha256()
    for room in ("neuspring", "tests"):
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in (".py", ".npz"):
                whole.update(f"{path.relative_to(ROOT).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return whole.hexdigest()[:16]


def line(record: dict[str, Any]) -> str:
    """A part in one line: its outcome, its time, and what was nearest to its limit or went wrong."""
    time_taken = "kept" if record.get("kept") else f"{record['seconds']:.1f} s"
    return f"{record['part']:<12}{record['outcome']:<8}{time_taken:>8}   {record['error'] or _summary(record['result'])}"


def _summary(result: dict[str, Any]) -> str:
    words = [
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in result.get("facts", {}).items()
    ]
    judged = [d for d in result.get("differences", []) if d["allowed"] > 0]
    if judged:
        worst = max(judged, key=lambda d: d["found"] / d["allowed"])
        unit = f" {worst['unit']}" if worst["unit"] else ""
        nearest = f"nearest to its limit: {worst['what']}, {worst['found']:.2g}{unit} of {worst['allowed']:.2g} allowed"
        words.insert(0, f"{len(result['differences'])} comparisons; {nearest}")
    return "; ".join(words)


def report(records: Sequence[dict[str, Any]]) -> str:
    """Every comparison in a table, then every part in a line."""
    rows = [f"\n{'part':<12}{'largest difference of':<56}{'found':>11}{'allowed':>11}  unit"]
    for record in records:
        for d in record.get("result", {}).get("differences", []):
            mark = "" if d["ok"] else "  <-- beyond"
            rows.append(f"{record['part']:<12}{d['what']:<56}{d['found']:>11.3g}{d['allowed']:>11.3g}  {d['unit']}{mark}")
    return "\n".join([*rows, "", *map(line, records)])
