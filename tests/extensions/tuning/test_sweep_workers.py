"""Workers of a sweep: as many trials as configured, however many workers there are and are killed; one more each at most."""

import multiprocessing
from pathlib import Path

import pytest

from neuspring.config.tuning import Tune
from neuspring.core.errors import InputError
from neuspring.extensions.tuning import trial, worker
from neuspring.extensions.tuning.report import state
from neuspring.twin.fit import TwinFit
from tests.extensions.tuning.sweeps import furnish, report, results_of, study, sweep, trials, work
from tests.support import stores


def test_a_killed_and_continued_sweep_finds_what_one_in_a_single_go_finds(tmp_path, finished, monkeypatch):
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)
    whole, tune = finished
    folder = furnish(tmp_path)
    epochs, run_epoch = 0, TwinFit.epoch

    def dying(self):
        nonlocal epochs
        epochs += 1
        # In the last of three epochs of the third trial.
        if epochs == 9:
            raise KeyboardInterrupt
        return run_epoch(self)

    monkeypatch.setattr(TwinFit, "epoch", dying)
    with pytest.raises(KeyboardInterrupt):
        work(folder, tune)
    assert [state(one) for one in trials(folder, tune).values()] == ["complete", "complete", "running"]
    assert work(folder, tune) == [2, 4], "number 3 continues trial 2"
    assert results_of(folder, tune) == results_of(whole, tune)
    assert epochs == 4 * 3 + 1, "two epochs of the third trial were not repeated"


def test_a_kill_between_asking_for_a_trial_and_taking_it_costs_nothing(folder, monkeypatch):
    import optuna

    tune, ask = sweep(trials=2), optuna.Study.ask

    def asked_and_killed(self):
        ask(self)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study, "ask", asked_and_killed)
        with pytest.raises(KeyboardInterrupt):
            work(folder, tune)
    assert work(folder, tune) == [0, 2]
    assert len(study(folder, tune).trials) == 3
    assert work(folder, sweep(trials=3)) == [3], "more trials continue a sweep"


def counting(calls: Path) -> None:
    """Note every search in a file, in this process."""
    searched = trial.search_stage

    def noted(*args, **kwargs):
        with calls.open("a") as stream:
            stream.write("search\n")
        searched(*args, **kwargs)

    trial.search_stage = noted


def other_worker(folder: Path, tune: Tune, start, hangs, calls: Path) -> None:
    """Worker 1 in a process of its own, which hangs in the first epoch of its second trial."""
    counting(calls)
    epochs, run_epoch = 0, TwinFit.epoch

    def epoch(self):
        nonlocal epochs
        epochs += 1
        if epochs > 3:
            hangs.set()
            multiprocessing.Event().wait()
        return run_epoch(self)

    TwinFit.epoch = epoch
    start.wait(120)
    work(folder, tune, 1)


def two_workers(folder: Path, tune: Tune) -> None:
    """Two workers begin a sweep of four trials together; one is killed in its second trial, the other goes on."""
    calls, processes = folder.parent / "calls", multiprocessing.get_context("spawn")
    start, hangs = processes.Barrier(2), processes.Event()
    other = processes.Process(target=other_worker, args=(folder, tune, start, hangs, calls))
    other.start()
    try:
        counting(calls)
        start.wait(120)
        mine = work(folder, tune, after=lambda: hangs.wait(120))
        states = {number: state(one) for number, one in trials(folder, tune).items()}
        left = [number for number, state in states.items() if state == "running"]
        # Both may look at the count at the same time.
        assert len(states) in (4, 5)
        assert len(mine) == len(states) - 2
        assert len(left) == 1, "the trial of a living worker is left alone"
    finally:
        other.kill()
        other.join()
    assert work(folder, tune, 1) == left, "the worker that was killed starts again"
    by_number = trials(folder, tune)
    assert {state(one) for one in by_number.values()} <= {"complete", "pruned"}
    assert len(study(folder, tune).trials) == len(by_number) + 1 and by_number[left[0]].number == len(by_number)
    assert calls.read_text() == "search\n", "workers that need the same search make it once"


def test_two_workers_and_a_kill_make_the_trials_asked_for(folder, monkeypatch):
    # Restored after the test.
    monkeypatch.setattr(trial, "search_stage", trial.search_stage)
    two_workers(folder, sweep(trials=4, workers=2))


@pytest.mark.slow
@pytest.mark.skipif(bool(stores.without_postgres()), reason=stores.without_postgres())
def test_postgresql_holds_a_sweep(folder, monkeypatch):
    monkeypatch.setattr(trial, "search_stage", trial.search_stage)
    with stores.postgres() as cluster:
        tune = sweep(trials=4, workers=2, storage=cluster.database("study"))
        two_workers(folder, tune)
        assert " of 4 trials" in report(folder, tune)
    assert not (folder / worker.DATABASE).exists()


def test_a_trial_of_a_worker_that_is_no_longer_configured_is_finished_by_another(folder, monkeypatch):
    def killed(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(TwinFit, "epoch", killed)
        with pytest.raises(KeyboardInterrupt):
            work(folder, sweep(workers=2), 1)
    assert work(folder, sweep(workers=2), 0) == [1, 2]
    assert work(folder, sweep(workers=1), 0) == [0]


def test_two_processes_cannot_be_the_same_worker(folder):
    refused = []

    def begin_again():
        with pytest.raises(InputError, match="one process at a time may be this worker; received 0"):
            work(folder, sweep(trials=1))
        refused.append(True)

    work(folder, sweep(trials=1), after=begin_again)
    assert refused == [True]
