"""Writes data/tables/timings.csv from job records: python -m tests.benchmarks.timings RESULTS "MACHINE" [RULE ...].

Run the benchmark alone on the machine before. Rules that are not named (default: all), or of which RESULTS has no jobs, keep their
rows. What we cannot measure is what others published, converted, and says so.
"""

import csv
import io
import statistics
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from neuspring.core.job_records import read_jobs
from neuspring.data.cases import released_cases
from neuspring.experiments.plan import SHIPPED, History, shipped_rates
from neuspring.experiments.size import RELEASED_SUBSTEPS

# "About 12 minutes" of CMA-ES (220 rollouts) and "about 5" of first-order optimization (200 epochs) for a stuffed animal without
# self-collision. Which one is not said: the animal in the middle, by training frames x springs of the released twin.
SEARCH_MINUTES, ROLLOUTS, FIT_MINUTES, EPOCHS = 12, 220, 5, 200
ANIMALS = ("sloth", "toy", "dinosor")
HEAD = """\
# Seconds per unit of work (experiments/plan.py), medians, and where from. Written by tests/benchmarks/timings.py.
# search, fit, rollout, transfer: per 1e9 spring updates, which is nanoseconds per spring, substep and twin.
"""


def published() -> dict[tuple[str, str], tuple[float, str]]:
    """(rule, kind) -> seconds per 1e9 spring updates, from PhysTwin's minutes, and how."""
    animals = {name: row for name, row in released_cases().items() if row["category"] in ANIMALS}
    size = {name: (int(row["train_end"]) - 1) * int(row["springs"]) for name, row in animals.items()}
    middle = statistics.median_low(size.values())
    case = next(name for name, value in size.items() if value == middle)
    giga = middle * RELEASED_SUBSTEPS / 1e9
    source = (
        f"PhysTwin's README: minutes of a stuffed animal on one RTX 4090, taken to be {case}: {animals[case]['springs']} springs,"
        f" {int(animals[case]['train_end']) - 1} training frames and {RELEASED_SUBSTEPS} substeps"
    )
    search, fit = SEARCH_MINUTES * 60 / (ROLLOUTS * giga), FIT_MINUTES * 60 / (EPOCHS * giga)
    rollout = f"{source}; a rollout as one of the search"
    return {
        ("search", "gpu"): (search, source),
        ("fit", "gpu"): (fit, source),
        ("rollout", "gpu"): (search, rollout),
        ("transfer", "gpu"): (search, rollout),
    }


def main(results: Path, machine: str, rules: Sequence[str] = ()) -> None:
    """Write the file."""
    jobs = read_jobs(results)
    counts = Counter(job.rule for job in jobs if job.last.outcome == "ok" and not job.last.devices)
    rows = {key: (rate.seconds, rate.source) for key, rate in shipped_rates().items()}
    for (rule, kind, scenario), seconds in History.of_records(jobs).rates.items():
        if kind == "cpu" and not scenario and rule in (rules or counts):
            rows[rule, kind] = (seconds, f"{machine}, {counts[rule]} job{'s' * (counts[rule] != 1)}")
    if not counts["transfer"]:
        seconds, source = rows["rollout", "cpu"]
        rows["transfer", "cpu"] = (seconds, f"{source} of rollout")
    rows |= published()
    text = io.StringIO()
    text.write(HEAD)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("rule", "kind", "seconds", "source"))
    writer.writerows(
        (*key, f"{seconds:.4g}", source) for key, (seconds, source) in sorted(rows.items(), key=lambda row: row[0][::-1])
    )
    SHIPPED.write_text(text.getvalue(), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
