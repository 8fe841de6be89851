"""A tuning study whose workers are killed at random moments: `python -m tests.benchmarks.bench_study`.

Four workers share 24 trials of a small fit, in PostgreSQL (where it is installed) and in SQLite; every few seconds one of them is
killed (SIGKILL) and started again, eight times in all. Printed: how long the study took, and whether it has exactly its trials.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from neuspring import config
from neuspring.config.tuning import Tune
from tests.support import stores
from tests.support.sweeps import furnish, settings, slots, sweep, work

WORKERS, TRIALS, KILLS = 4, 24, 8
PAUSE = (6.0, 12.0)
"""s between kills: a worker takes a few to start, and one that has not started has nothing to lose."""
EPOCHS = 60
"""Of a trial's fit: a few seconds."""


def base() -> config.Config:
    """What the trials vary."""
    return settings(fit={"epochs": EPOCHS})


def one_worker(folder: Path, chosen: Tune, number: int) -> None:
    work(folder, chosen, number, base())


def run(folder: Path, storage: str | None, seed: int = 0) -> str:
    """Make a study in `folder`; says how it went. Raises AssertionError for a trial too many or too few."""
    place = furnish(folder)
    chosen = sweep(trials=TRIALS, workers=WORKERS, pruner="none", storage=storage)
    processes, rng = multiprocessing.get_context("spawn"), np.random.default_rng(seed)

    def begin(number: int) -> multiprocessing.process.BaseProcess:
        process = processes.Process(target=one_worker, args=(place, chosen, number))
        process.start()
        return process

    start, kills = time.perf_counter(), 0
    workers = {number: begin(number) for number in range(WORKERS)}
    while kills < KILLS:
        time.sleep(rng.uniform(*PAUSE))
        alive = [number for number, process in workers.items() if process.is_alive()]
        if not alive:
            break
        victim = int(rng.choice(alive))
        workers[victim].kill()
        workers[victim].join()
        kills += 1
        workers[victim] = begin(victim)
    for process in workers.values():
        process.join()
        assert process.exitcode == 0, f"a worker ended with {process.exitcode}"
    seconds = time.perf_counter() - start
    ended = slots(place, chosen, base()).values()
    complete = sum(slot.state == "complete" for slot in ended)
    assert (len(ended), complete) == (TRIALS, TRIALS), f"{complete} of {len(ended)} trials are complete, not {TRIALS}"
    again = sum(len(slot.trials) for slot in ended) - TRIALS
    return f"{seconds:.0f} s, {kills} kills, {complete} of {TRIALS} trials complete, {again} of them begun again"


def main(seed: int = 0) -> None:
    """Print both studies."""
    with tempfile.TemporaryDirectory() as name:
        if reason := stores.without_postgres():
            print(reason)
        else:
            with stores.postgres() as cluster:
                print("PostgreSQL:", run(Path(name) / "postgresql", cluster.database("study"), seed))
        print("SQLite:", run(Path(name) / "sqlite", None, seed))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
