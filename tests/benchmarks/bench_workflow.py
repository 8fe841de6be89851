"""What the workflow adds to its jobs, and how it uses GPUs: python -m tests.benchmarks.bench_workflow [jobs] [seconds].

A simulated server of 8 GPUs: fake devices, the real wrapper and leases, jobs that sleep. First all jobs end well: what Snakemake
and the wrapper add to each, and how much of the time the devices are held. Then each is killed once in the middle, at random, and
tried again: no device may ever be held twice. The machine needs cores for 8 sleeping jobs' starts: on two, jobs of under three
seconds are limited by those, not by the leases.
"""

import os
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from itertools import pairwise
from pathlib import Path

from neuspring.core.job_records import JobRecord, read_jobs
from neuspring.experiments.jobs import gpus
from neuspring.experiments.jobs import wrapper as job

DEVICES = 8
SNAKEFILE = """
rule all:
    input: expand("results/done/{i}", i=range({jobs}))
rule nap:
    output: "results/done/{{i}}"
    log: "results/logs/nap/{{i}}.log"
    retries: 2
    resources: gpu=1, attempt=lambda wildcards, attempt: attempt
    shell: "{python} -m neuspring.experiments.jobs.wrapper --log {{log}} --gpus 1 -- {nap} && touch {{output}}"
"""
WELL = "sleep {seconds}"
CRASH = """bash -c 'if [ {{resources.attempt}} = 1 ]; then sleep 0.$((RANDOM % 9)); kill -9 $$; fi; sleep {seconds}'"""


def run(folder: Path, jobs: int, nap: str) -> tuple[float, list[JobRecord]]:
    """Seconds of the whole run, and the records of its jobs."""
    folder.mkdir()
    (folder / "Snakefile").write_text(SNAKEFILE.replace("{i}", "{{i}}", 1).format(jobs=jobs, python=sys.executable, nap=nap))
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[2]),
        job.POOL: ",".join(map(str, range(DEVICES))),
        gpus.LOCKS: str(folder / "locks"),
    }
    command = [sys.executable, "-m", "snakemake", "--cores", str(4 * DEVICES), "--resources", f"gpu={DEVICES}", "--quiet", "all"]
    start = time.perf_counter()
    subprocess.run([*command, "--scheduler", "greedy"], cwd=folder, env=environment, check=True)
    return time.perf_counter() - start, read_jobs(folder / "results")


def intervals(records: list[JobRecord]) -> dict[str, list[tuple[float, float]]]:
    """Device -> when it was held, in order of time."""
    held: dict[str, list[tuple[float, float]]] = {}
    for attempt in (attempt for record in records for attempt in record.attempts):
        start = datetime.fromisoformat(attempt.started).timestamp()
        held.setdefault(attempt.devices[0], []).append((start, start + attempt.seconds))
    return {device: sorted(times) for device, times in held.items()}


def utilization(records: list[JobRecord]) -> float:
    """Held time over all time, from the first start to the last start of a job (what follows is the end of the queue)."""
    held = intervals(records)
    first = min(times[0][0] for times in held.values())
    last = max(times[-1][0] for times in held.values())
    busy = sum(min(end, last) - start for times in held.values() for start, end in times if start < last)
    return busy / (DEVICES * (last - first))


def doubled(records: list[JobRecord], tolerance: float = 0.002) -> int:
    """Holders that began before the one before them had ended; `tolerance` s: starts are kept in milliseconds."""
    return sum(b[0] < a[1] - tolerance for times in intervals(records).values() for a, b in pairwise(times))


def main(jobs: int = 500, seconds: float = 4.0) -> None:
    """Print both runs."""
    with tempfile.TemporaryDirectory() as folder:
        wall, records = run(Path(folder) / "well", jobs, WELL.format(seconds=seconds))
        added = (wall * DEVICES - jobs * seconds) / jobs
        print(f"{jobs} jobs of {seconds} s on {DEVICES} devices: {wall:.1f} s, ideally {jobs * seconds / DEVICES:.1f} s")
        print(f"added per job: {added:.2f} s ({added / 60:.1%} of a minute); devices held {utilization(records):.1%} of the time")
        wall, records = run(Path(folder) / "crash", jobs, CRASH.format(seconds=1))
        attempts = [attempt for record in records for attempt in record.attempts]
        crashed = sum(attempt.outcome == "transient" for attempt in attempts)
        print(f"{crashed} of {len(attempts)} attempts killed: {wall:.1f} s, {doubled(records)} devices held twice")
        print(f"finished in the end: {sum(not record.failed for record in records)} of {jobs}")


if __name__ == "__main__":
    main(*(kind(text) for kind, text in zip((int, float), sys.argv[1:], strict=False)))
