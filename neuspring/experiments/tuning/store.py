"""The study that workers share: an Optuna study in SQLite or PostgreSQL, and who works on which trial.

A study has slots 0 .. trials - 1; each is filled by one finished, pruned or failed trial. A worker takes the lowest free slot
while it holds the study's lock, so that together workers make exactly as many trials as were asked for. A worker also holds a
lock of its own as long as it lives. A trial that runs for a worker whose lock is free was left behind by a killed one: its slot
becomes free again and keeps the values, so that fits continue from their checkpoints.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from neuspring.core.errors import InputError
from neuspring.core.records import canonical

if TYPE_CHECKING:
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import RDBStorage
    from optuna.study import Study
    from optuna.trial import FrozenTrial, Trial
    from sqlalchemy import Engine

DATABASE = "optuna.db"
DEFINITION = "definition"
SLOT, WORKER, REASON, CRASH = "slot", "worker", "reason", "crash"
"""Attributes of a trial. A failed trial with a reason fills its slot; one without was left behind or crashed."""
MOST_DEATHS = 5
"""A slot whose trial ends its worker this often counts as failed, so that the study ends."""
PATIENCE = 60.0
"""Seconds that SQLite waits for another writer."""


class Locks(Protocol):
    """Locks that their holder's death frees."""

    def hold(self, name: str) -> contextlib.AbstractContextManager[object]:
        """Wait for a lock and hold it."""

    def is_free(self, name: str) -> bool:
        """Whether nobody holds a lock."""


@dataclass(frozen=True)
class FileLocks:
    """Locks of one machine: files in `folder`."""

    folder: Path

    def hold(self, name: str) -> contextlib.AbstractContextManager[object]:
        """Wait for a lock and hold it."""
        from filelock import FileLock

        self.folder.mkdir(parents=True, exist_ok=True)
        return FileLock(self.folder / f"{name}.lock")

    def is_free(self, name: str) -> bool:
        """Whether nobody holds a lock."""
        from filelock import FileLock, Timeout

        try:
            with FileLock(self.folder / f"{name}.lock", timeout=0):
                return True
        except Timeout:
            return False


@dataclass(frozen=True)
class DatabaseLocks:
    """Locks of all machines that share a PostgreSQL server; each lives as long as its connection."""

    uri: str
    study: str

    def _number(self, name: str) -> int:
        return int.from_bytes(hashlib.sha256(f"neuspring {self.study} {name}".encode()).digest()[:8], "big", signed=True)

    @contextlib.contextmanager
    def hold(self, name: str) -> Iterator[None]:
        """Wait for a lock and hold it."""
        import sqlalchemy

        with self._engine().connect() as connection:
            connection.execute(sqlalchemy.text("SELECT pg_advisory_lock(:number)"), {"number": self._number(name)})
            yield

    def is_free(self, name: str) -> bool:
        """Whether nobody holds a lock."""
        import sqlalchemy

        with self._engine().connect() as connection:
            taken = sqlalchemy.text("SELECT pg_try_advisory_lock(:number)")
            return bool(connection.execute(taken, {"number": self._number(name)}).scalar())

    def _engine(self) -> Engine:
        import sqlalchemy

        # A lock is held for hours without a word.
        alive = {"keepalives_idle": 30, "keepalives_interval": 10}
        try:
            # A pool would keep the connection, and its locks with it.
            return sqlalchemy.create_engine(
                self.uri, poolclass=sqlalchemy.NullPool, isolation_level="AUTOCOMMIT", connect_args=alive
            )
        except ImportError as error:
            raise InputError("tune.storage", "PostgreSQL needs a driver", error, "pip install psycopg2-binary") from error


@dataclass(frozen=True)
class Store:
    """Where a study is kept: its folder, and a PostgreSQL URI or None for a SQLite file in the folder."""

    folder: Path
    uri: str | None
    study: str

    @property
    def locks(self) -> Locks:
        """The locks of this study's workers."""
        return DatabaseLocks(self.uri, self.study) if self.uri else FileLocks(self.folder / ".locks")

    def open(self, facts: Mapping[str, Any], sampler: BaseSampler, pruner: BasePruner) -> Study:
        """The study, made if there is none. Raises InputError if the one there was begun with other `facts`."""
        import optuna

        self.folder.mkdir(parents=True, exist_ok=True)
        # Several processes must not create the tables at once.
        with self.locks.hold("study"):
            storage = self._storage()
            study = optuna.create_study(
                storage=storage, study_name=self.study, sampler=sampler, pruner=pruner, load_if_exists=True, direction="minimize"
            )
            if DEFINITION not in study.user_attrs:
                study.set_user_attr(DEFINITION, dict(facts))
            self._require_same(study, facts)
            return study

    def load(self, facts: Mapping[str, Any]) -> Study:
        """The study for reading. Raises InputError if there is none, or if it was begun with other `facts`."""
        import optuna

        missing = InputError(f"study {self.study}", "must have been begun", None, "Run neuspring tune first.")
        if self.uri is None and not (self.folder / DATABASE).is_file():
            raise missing
        try:
            with self.locks.hold("study"):
                study = optuna.load_study(storage=self._storage(), study_name=self.study)
        except KeyError as error:
            raise missing from error
        if DEFINITION not in study.user_attrs:
            raise missing
        self._require_same(study, facts)
        return study

    def _require_same(self, study: Study, facts: Mapping[str, Any]) -> None:
        known = {name: study.user_attrs[DEFINITION].get(name) for name in facts}
        if canonical(known) != canonical(facts):
            raise InputError(
                f"study {self.study}",
                "must go on with what it was begun with",
                f"another {', '.join(_differences(known, facts))}",
                f"Name a new study (tune.study), or delete this one{'' if self.uri else f' ({self.folder})'}.",
            )

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


def _differences(known: Mapping[str, Any], facts: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Dotted names of what differs."""
    names: list[str] = []
    for key in sorted({*known, *facts}):
        old, new = known.get(key), facts.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            names += _differences(old, new, f"{prefix}{key}.")
        elif old != new:
            names.append(f"{prefix}{key}")
    return names


@dataclass(frozen=True)
class Slot:
    """A place for one trial, with those that were begun for it, oldest first; the last decides."""

    number: int
    trials: tuple[FrozenTrial, ...]

    @property
    def state(self) -> Literal["complete", "pruned", "failed", "running", "waiting", "free"]:
        """What became of it; free: its trials were left behind, too few to give up. Waiting: about to run."""
        from optuna.trial import TrialState

        last = self.trials[-1]
        if last.state != TrialState.FAIL:
            names = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.RUNNING: "running"}
            return names.get(last.state, "waiting")  # type: ignore[return-value]
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
    found: dict[int, list[FrozenTrial]] = {}
    for trial in study.get_trials(deepcopy=False):
        found.setdefault(trial.user_attrs[SLOT], []).append(trial)
    return {number: Slot(number, tuple(found[number])) for number in sorted(found)}


def claim(study: Study, locks: Locks, worker: int, limit: int, first: Mapping[str, Any]) -> Trial | None:
    """A trial of the lowest free slot below `limit`, None if there is none. `first` are the values of slot 0.

    The caller holds the lock of `worker` and runs no other trial.
    """
    from optuna.trial import TrialState

    with locks.hold("study"):
        for left in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            owner = left.user_attrs.get(WORKER)
            # Without an owner: killed between taking the trial and saying so, which happens under this lock.
            if owner in (None, worker) or locks.is_free(worker_lock(owner)):
                study.tell(left.number, state=TrialState.FAIL)
        known = slots(study)
        # Waiting: killed between asking for a trial and taking it.
        if not any(slot.state == "waiting" for slot in known.values()):
            free = (number for number in range(limit) if number not in known or known[number].state == "free")
            number = next(free, None)
            if number is None:
                return None
            values = dict(first) if number == 0 else {}
            study.enqueue_trial(values | (known[number].trials[-1].params if number in known else {}), user_attrs={SLOT: number})
        trial = study.ask()
        trial.set_user_attr(WORKER, worker)
        return trial


def worker_lock(worker: int) -> str:
    """The name of a worker's own lock."""
    return f"worker-{worker}"
