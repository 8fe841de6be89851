"""Processes that log run records at once: `python -m tests.support.loggers RESULTS SETTINGS OUT < JSON list of lists of run.json`.

mlflow is imported once, which takes seconds, and then forked into one process per list. Process i writes its id to OUT/i.pid and
a line to OUT/i.tsv for every record: seconds, outcome, path.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

from neuspring.config import Tracking
from neuspring.core.files import write_text
from neuspring.experiments.tracking import log as tracking
from neuspring.experiments.tracking import store as tracking_store

ROOT = Path(__file__).resolve().parents[2]


def start(groups: list[list[Path]], results: Path, settings: Tracking, out: Path) -> subprocess.Popen[str]:
    """Start one logger per group; the returned process ends when all of them have."""
    out.mkdir(parents=True, exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if name not in tracking_store.ENVIRONMENT}
    command = [sys.executable, "-m", "tests.support.loggers", str(results), json.dumps(asdict(settings)), str(out)]
    with (out / "stderr").open("w") as errors:
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stderr=errors, text=True)
    assert process.stdin is not None
    process.stdin.write(json.dumps([[str(path) for path in group] for group in groups]))
    process.stdin.close()
    return process


def outcomes(out: Path) -> list[tuple[float, str, str]]:
    """Seconds, outcome and path of every record so far."""
    lines = [line for path in sorted(out.glob("*.tsv")) for line in path.read_text().splitlines(keepends=True)]
    fields = [line.rstrip("\n").split("\t") for line in lines if line.endswith("\n")]
    return [(float(seconds), outcome, path) for seconds, outcome, path in fields]


def _log(records: list[str], results: Path, settings: Tracking, out: Path, index: int) -> None:
    # Whole or not there: the test reads it as soon as it is.
    write_text(out / f"{index}.pid", str(os.getpid()))
    with (out / f"{index}.tsv").open("w", buffering=1) as lines:
        for record in records:
            start = time.perf_counter()
            outcome = tracking.log_run(Path(record), results, settings)
            print(f"{time.perf_counter() - start:.3f}", outcome, record, sep="\t", file=lines)


def main() -> None:
    results, settings, out = Path(sys.argv[1]), Tracking(**json.loads(sys.argv[2])), Path(sys.argv[3])
    os.environ.update(tracking_store.ENVIRONMENT)
    for name in ("mlflow.store.tracking.sqlalchemy_store", "mlflow.store.tracking.rest_store", "pandas", "pyarrow.parquet"):
        importlib.import_module(name)
    for index, records in enumerate(json.load(sys.stdin)):
        if os.fork() == 0:
            _log(records, results, settings, out, index)
            os._exit(0)
    try:
        while True:
            os.wait()
    except ChildProcessError:
        return


if __name__ == "__main__":
    main()
