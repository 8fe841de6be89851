"""Time to log a run to MLflow: `python -m tests.benchmarks.bench_tracking [--writers 1 16] [--runs 3] [--repeats 3]`.

A run has 120 parameters, 1100 points of a loss and three files. The stores take turns within a repeat, so that other work of
the machine meets all of them. Columns: median and longest time of `log_run`, runs per second of all writers together and runs that
did not arrive; last the median as a multiple of that of SQLite with the first number of writers, in the same repeat. All but the
count are medians over repeats. Writers import mlflow before they begin. PostgreSQL takes part where it is installed.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import NamedTuple

import psutil

from neuspring.config import Tracking
from neuspring.experiments.tracking import log as tracking
from tests.support import loggers, stores


class Times(NamedTuple):
    """Of one repeat."""

    median: float
    longest: float
    rate: float
    """Runs per second."""
    missing: int


def bench(folder: Path, settings: Tracking, writers: int, runs: int) -> Times:
    """Log `runs` runs of each of the writers to a store that is ready."""
    results = folder / "results"
    groups = [[stores.write_run(results, f"s{writer}", seed) for seed in range(runs)] for writer in range(writers)]
    assert tracking.init(results, settings)["outcome"] == "ready"
    loggers.start(groups, results, settings, folder).wait()
    found = loggers.outcomes(folder)
    seconds = [time for time, _, _ in found]
    # Writers do nothing but log, so the longest sum is the time from the first run to the last.
    busy = max(sum(time for time, _, path in found if f"/s{writer}/" in path) for writer in range(writers))
    return Times(median(seconds), max(seconds), len(found) / busy, sum(outcome != "logged" for _, outcome, _ in found))


def memory_mib(server: stores.Server) -> float:
    """Resident memory of the server and its worker."""
    parent = psutil.Process(server.process.pid)
    return sum(float(process.memory_info().rss) for process in (parent, *parent.children(recursive=True))) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--writers", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--runs", type=int, default=3, help="of every writer")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    with ExitStack() as stack:
        base = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        template = base / "template"
        assert tracking.init(template, Tracking(experiment="template"))["outcome"] == "ready"
        uris: dict[str, str | None] = {"SQLite": None}
        servers = {}
        if reason := stores.without_postgres():
            print(reason)
        else:
            cluster = stack.enter_context(stores.postgres())
            uris["PostgreSQL"] = cluster.database("direct")
            behind = cluster.database("behind")
            assert tracking.init(base, Tracking(uri=behind, experiment="template"))["outcome"] == "ready"
            servers["server + PostgreSQL"] = stack.enter_context(stores.server(base, behind))
            uris["server + PostgreSQL"] = servers["server + PostgreSQL"].uri
        taken: dict[tuple[str, int], list[Times]] = {}
        for repeat in range(options.repeats):
            for writers in options.writers:
                for name, uri in uris.items():
                    folder = base / f"{repeat}-{writers}-{name}"
                    (folder / "results").mkdir(parents=True)
                    if uri is None:
                        shutil.copy(template / "mlflow.db", folder / "results")
                    settings = Tracking(uri=uri, experiment=f"r{repeat}w{writers}")
                    taken.setdefault((name, writers), []).append(bench(folder, settings, writers, options.runs))
        print(f"{'store':<20}{'writers':>8}{'s/run':>8}{'longest':>9}{'runs/s':>8}{'missing':>9}{'ratio':>7}")
        base_times = taken["SQLite", options.writers[0]]
        for (name, writers), times in taken.items():
            ratio = median(one.median / base_time.median for one, base_time in zip(times, base_times, strict=True))
            row = [median(one[i] for one in times) for i in range(3)]
            missing = sum(one.missing for one in times)
            print(f"{name:<20}{writers:>8}{row[0]:>8.2f}{row[1]:>9.2f}{row[2]:>8.2f}{missing:>9}{ratio:>7.1f}")
        for name, server in servers.items():
            print(f"{name}: {memory_mib(server):.0f} MiB with one worker")


if __name__ == "__main__":
    main()
