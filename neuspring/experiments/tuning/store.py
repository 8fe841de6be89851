"""The sweep that workers share: an Optuna study in SQLite or PostgreSQL, and who works on which trial.

A sweep has slots 0 .. trials - 1. Each is filled by one finished, pruned or failed trial. A worker takes the lowest free slot
under the sweep's lock, so that together workers make exactly as many trials as were asked for. When a killed worker starts again,
it frees the slot of the trial that it left running. The slot keeps its values, so that fits continue from their checkpoints.

Optuna's own means do not give an exact number of trials. `MaxTrialsCallback` counts after a trial, when other workers have begun
more. Its heartbeat notices a dead worker only after minutes, and never one that died before the first beat; a worker's number
tells at once.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock

from neuspring.core.errors import InputError
from neuspring.core.records import canonical
from neuspring.core.run_record import flat

if TYPE_CHECKING:
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import RDBStorage
    from optuna.study import Study
    from optuna.trial import FrozenTrial, Trial

    from neuspring.config.tuning import Tune

DATABASE = "optuna.db"
DEFINITION = "definition"
SLOT, WORKER, REASON, CRASH = "slot", "worker", "reason", "crash"
"""Attributes of a trial. A failed trial with a reason fills its slot; one without was left behind or crashed."""
MOST_DEATHS = 5
"""A slot whose trial ends its worker this often counts as failed, so that the sweep ends."""
PATIENCE = 60.0
"""Seconds that SQLite waits for another writer."""


@dataclass(frozen=True)
class Store:
    """Where a sweep is kept: its folder, and a PostgreSQL URI or None for a SQLite file in the folder."""

    folder: Path
    uri: str | None
    study: str

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep against its other workers; the death of the holder frees it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.uri is None:
            with FileLock(self.folder / ".lock"):
                yield
            return
        import sqlalchemy

        try:
            # The lock is the connection's; a pool would keep both.
            engine = sqlalchemy.create_engine(self.uri, poolclass=sqlalchemy.NullPool, isolation_level="AUTOCOMMIT")
        except ImportError as error:
            raise InputError("tune.storage", "PostgreSQL needs a driver", error, "pip install psycopg2-binary") from error
        with engine.connect() as connection:
            digest = hashlib.sha256(f"neuspring {self.study} study".encode()).digest()
            number = int.from_bytes(digest[:8], "big", signed=True)
            connection.execute(sqlalchemy.text("SELECT pg_advisory_lock(:number)"), {"number": number})
            yield

    def open(self, facts: Mapping[str, Any], pruner: BasePruner) -> Study:
        """The sweep, made if there is none. Raises InputError if it was begun with other `facts`."""
        import optuna

        # Several processes must not create the tables at once.
        with self.lock():
            study = optuna.create_study(
                storage=self._storage(), study_name=self.study, pruner=pruner, load_if_exists=True, direction="minimize"
            )
            if DEFINITION not in study.user_attrs:
                study.set_user_attr(DEFINITION, dict(facts))
        return self._checked(study, facts)

    def load(self, facts: Mapping[str, Any]) -> Study:
        """The sweep for reading. Raises InputError if there is none, or if it was begun with other `facts`."""
        import optuna

        if self.uri or (self.folder / DATABASE).is_file():
            with contextlib.suppress(KeyError), self.lock():
                study = optuna.load_study(storage=self._storage(), study_name=self.study)
                if DEFINITION in study.user_attrs:
                    return self._checked(study, facts)
        raise InputError(f"sweep {self.study}", "must have been begun", None, "Run neuspring tune first.")

    def _checked(self, study: Study, facts: Mapping[str, Any]) -> Study:
        definition = {name: study.user_attrs[DEFINITION].get(name) for name in facts}
        if canonical(definition) != canonical(facts):
            raise InputError(
                f"sweep {self.study}",
                "must go on with what it was begun with",
                f"another {', '.join(_differences(definition, facts))}",
                f"Name a new sweep (tune.study), or delete this one{'' if self.uri else f' ({self.folder})'}.",
            )
        return study

    def _storage(self) -> RDBStorage:
        from optuna import logging
        from optuna.storages import RDBStorage
        from sqlalchemy import URL

        logging.set_verbosity(logging.WARNING)
        if self.uri is None:
            path = str((self.folder / DATABASE).resolve())
            uri = URL.create("sqlite", database=path).render_as_string()
            return RDBStorage(uri, engine_kwargs={"connect_args": {"timeout": PATIENCE}})
        # A server may close connections that are idle during a long fit.
        return RDBStorage(self.uri, engine_kwargs={"pool_pre_ping": True})


def _differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Dotted names of what differs."""
    before, after = flat(first), flat(second)
    return [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]


@dataclass(frozen=True)
class Slot:
    """A place for one trial, with the trials that were begun for it, oldest first. The last one decides."""

    number: int
    trials: tuple[FrozenTrial, ...]

    @property
    def state(self) -> Literal["complete", "pruned", "failed", "running", "waiting", "free"]:
        """Free: all its trials were left behind or crashed, too few times to give up. Waiting: about to run."""
        from optuna.trial import TrialState

        last = self.trials[-1]
        if last.state != TrialState.FAIL:
            return last.state.name.lower()  # type: ignore[return-value]
        return "failed" if REASON in last.user_attrs or len(self.trials) >= MOST_DEATHS else "free"

    @property
    def reason(self) -> str:
        """Why it was pruned or failed, empty otherwise."""
        attributes = self.trials[-1].user_attrs
        if self.state not in ("pruned", "failed"):
            return ""
        given_up = f"given up after {len(self.trials)} attempts, the last: {attributes.get(CRASH, 'its worker was killed')}"
        return str(attributes.get(REASON, given_up))


def slots(study: Study) -> dict[int, Slot]:
    """The slots for which trials were begun, in order."""
    trials: dict[int, list[FrozenTrial]] = {}
    for trial in study.get_trials(deepcopy=False):
        trials.setdefault(trial.user_attrs[SLOT], []).append(trial)
    return {number: Slot(number, tuple(trials[number])) for number in sorted(trials)}


def claim(study: Study, worker: int, tune: Tune, first: Mapping[str, Any], sampler: Callable[[int], BaseSampler]) -> Trial | None:
    """A trial of the lowest free slot, None if there is none. `first` are the values of slot 0; each slot has its `sampler`.

    The caller holds the sweep's lock, is the only process that is `worker`, and runs no other trial.
    """
    from optuna.trial import TrialState

    for running in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        owner = running.user_attrs.get(WORKER)
        # Left behind by this worker's earlier process; by a process killed under this lock, before it named its worker; or by a
        # worker that the configuration no longer has.
        if owner in (None, worker) or owner >= tune.workers:
            study.tell(running.number, state=TrialState.FAIL)
    begun = slots(study)
    # A trial that waits was left between being queued and being taken.
    number = next((n for n, slot in begun.items() if slot.state == "waiting"), None)
    if number is None:
        number = next((n for n in range(tune.trials) if n not in begun or begun[n].state == "free"), None)
        if number is None:
            return None
        values = begun[number].trials[-1].params if number in begun else {}
        study.enqueue_trial((dict(first) if number == 0 else {}) | values, user_attrs={SLOT: number})
    study.sampler = sampler(number)
    trial = study.ask()
    trial.set_user_attr(WORKER, worker)
    return trial
