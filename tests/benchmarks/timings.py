"""Writes data/tables/timings.csv from the job records of a results folder: python -m tests.benchmarks.timings RESULTS "MACHINE".

Run the benchmark alone on the machine before. What we cannot measure is what others published, and says so.
"""

import csv
import io
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from neuspring.core.job_records import read_jobs
from neuspring.experiments.plan import SHIPPED

# "About 12 minutes" of CMA-ES (220 rollouts) and "about 5" of first-order optimisation (200 epochs) for stuffed animals without
# self-collision, whose scenarios have some 50 training frames.
PUBLISHED = "PhysTwin's README: minutes of a stuffed animal on one RTX 4090; cloth takes longer"
GPU = {"search": 12 * 60 / (220 * 50), "fit": 5 * 60 / (200 * 50)}


def main(results: Path, machine: str) -> None:
    """Write the file."""
    rates = defaultdict(list)
    for job in read_jobs(results):
        if job.last.outcome == "ok" and not job.last.devices:
            rates[job.rule].append(job.last.seconds / job.work)
    rows = [
        (rule, "cpu", f"{statistics.median(times):.4g}", f"{machine}, {len(times)} jobs") for rule, times in sorted(rates.items())
    ]
    rows += [(rule, "gpu", f"{seconds:.4g}", PUBLISHED) for rule, seconds in GPU.items()]
    text = io.StringIO()
    text.write(
        "# Seconds per unit of work (experiments/plan.py), medians, and where from. Written by tests/benchmarks/timings.py.\n"
    )
    csv.writer(text, lineterminator="\n").writerows([("rule", "kind", "seconds", "source"), *rows])
    SHIPPED.write_text(text.getvalue(), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
