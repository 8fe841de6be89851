"""One worker of a sweep, a job of the workflow: it runs trials until the sweep has as many as configured.

Workers share an Optuna study, in SQLite or PostgreSQL, so each may be on another GPU or machine. A worker asks for a trial under a
lock in the sweep's folder, and only while fewer count than were asked for: Optuna's `MaxTrialsCallback` counts after a trial, when
other workers have begun more. When a killed worker starts again, the trial that it left running is queued anew with its values, so
that its fits continue from their checkpoints.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import json
import math
import socket
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from filelock import FileLock, Timeout
from optuna.pruners import BasePruner, MedianPruner, NopPruner
from optuna.samplers import BaseSampler, TPESampler
from optuna.storages import RDBStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, Trial, TrialState

from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core import provenance
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, canonical, now
from neuspring.core.run_record import flat
from neuspring.experiments.tuning.space import Plan, holds, label, labels
from neuspring.experiments.tuning.trial import Outcome, Scene, checkpoint, run

DATABASE = "optuna.db"
DEFINITION = "definition"
"""Attribute of the study: what must not change while it lasts."""
ORIGIN, WORKER, REASON = "origin", "worker", "reason"
"""Attributes of a trial: the number of the one that it continues, its worker, why it ended early (unless it was left behind)."""
FACTS, VALUES = "facts", "values"
"""Attributes of a trial: how it went, and its values. The baseline's include those that the space cannot hold."""
MOST_DEATHS = 5
"""A trial that ends its worker this often is not continued; another takes its place."""
PATIENCE = 60.0
"""Seconds that SQLite waits for another writer."""


def lock_of(folder: Path) -> FileLock:
    """Holds the sweep in `folder` against its other workers; the death of the holder frees it."""
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".lock")


def study_of(folder: Path, tune: Tune, facts: Mapping[str, Any], pruner: BasePruner | None = None) -> Study:
    """A sweep, which is made if there is none and it is given a `pruner`; it is kept in SQLite in its folder, or in PostgreSQL.

    Raises InputError if there is none, or if it was begun with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    path, begun = folder / DATABASE, None
    uri = tune.storage or sqlalchemy.URL.create("sqlite", database=str(path.resolve())).render_as_string()
    # A server may close connections that are idle during a long fit.
    engine = {"pool_pre_ping": True} if tune.storage else {"connect_args": {"timeout": PATIENCE}}
    # Several processes must not create the tables at once.
    with lock_of(folder):
        if pruner or tune.storage or path.is_file():
            try:
                storage = RDBStorage(uri, engine_kwargs=engine)
            except ImportError as error:
                raise InputError("tune.storage", "PostgreSQL needs a driver", error, "pip install psycopg2-binary") from error
            if pruner:
                study = optuna.create_study(storage=storage, study_name=tune.study, pruner=pruner, load_if_exists=True)
                if DEFINITION not in study.user_attrs:
                    study.set_user_attr(DEFINITION, dict(facts))
            with contextlib.suppress(KeyError):
                study = optuna.load_study(storage=storage, study_name=tune.study, pruner=pruner)
                begun = study.user_attrs[DEFINITION]
    if begun is None:
        raise InputError(f"sweep {tune.study}", "must have been begun", None, "Run neuspring tune first.")
    definition = {name: begun.get(name) for name in facts}
    if canonical(definition) != canonical(facts):
        before, after = flat(definition), flat(facts)
        changed = [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]
        remedy = f"Name a new sweep (tune.study), or delete this one{'' if tune.storage else f' ({folder})'}."
        rule = "must go on with what it was begun with"
        raise InputError(f"sweep {tune.study}", rule, f"another {', '.join(changed)}", remedy)
    return study


def origin(trial: FrozenTrial | Trial) -> int:
    """The number of the trial that it continues; its own if none. Trial 0 is the baseline."""
    return int(trial.user_attrs.get(ORIGIN, trial.number))


def counted(study: Study) -> list[FrozenTrial]:
    """The trials that count, by origin: finished, pruned and running ones, and those that failed by their settings."""
    there = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
    return sorted((t for t in study.get_trials(deepcopy=False) if t.state in there or REASON in t.user_attrs), key=origin)


def claim(study: Study, worker: int, tune: Tune, first: Mapping[str, Any], sampler: Callable[[int], BaseSampler]) -> Trial | None:
    """A trial to run, None if there are enough. `first` are the values of the baseline; the n-th that counts has its `sampler`.

    The caller holds the sweep's lock, is the only process that is `worker`, and runs no other trial.
    """
    begun = study.get_trials(deepcopy=False)
    for left in begun:
        owner = left.user_attrs.get(WORKER)
        # Left behind by this worker's earlier process; by a process killed under this lock, before it named its worker; or by a
        # worker that the configuration no longer has.
        if left.state == TrialState.RUNNING and (owner in (None, worker) or owner >= tune.workers):
            if sum(origin(trial) == origin(left) for trial in begun) < MOST_DEATHS:
                values = (dict(first) if origin(left) == 0 else {}) | left.params
                study.enqueue_trial(values, user_attrs={ORIGIN: origin(left)})
            study.tell(left.number, state=TrialState.FAIL)
    if not begun:
        study.enqueue_trial(dict(first))
    count = len(counted(study))
    if count >= tune.trials and not study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
        return None
    study.sampler = sampler(count)
    trial = study.ask()
    trial.set_user_attr(WORKER, worker)
    return trial


def sampler_of(tune: Tune, count: int, *, grouped: bool) -> BaseSampler:
    """TPE with a seed of its own behind `count` trials. `grouped`: the baseline's trial lacks values that the space cannot hold."""
    seed = int.from_bytes(hashlib.sha256(f"{tune.seed} {count}".encode()).digest()[:4], "big")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return TPESampler(seed=seed, n_startup_trials=tune.startup_trials, multivariate=True, group=grouped, constant_liar=True)


class MedianOfStep(BasePruner):
    """Optuna's median rule, on the last value alone: losses at different steps are of different scenarios."""

    def __init__(self, tune: Tune, warmup: int) -> None:
        # There is no median before one trial has finished.
        self._inner = MedianPruner(n_startup_trials=max(tune.startup_trials, 1), n_warmup_steps=warmup)

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Whether the trial is above the median of completed ones at its last step."""
        if trial.last_step is None:
            return False
        last = copy.copy(trial)
        last.intermediate_values = {trial.last_step: trial.intermediate_values[trial.last_step]}
        return self._inner.prune(study, last)


def pruner_of(tune: Tune, scenarios: int, epochs: int) -> BasePruner:
    """The pruner of a sweep whose trials have at most `epochs` steps for each of its scenarios."""
    # The loss of one scenario says little about the mean.
    unpruned = math.ceil(scenarios / 3) if scenarios > 1 else 0
    warmup = unpruned * epochs + tune.warmup_epochs
    return MedianOfStep(tune, warmup) if tune.pruner == "median" else NopPruner()


def suggest(trial: Trial, name: str, plan: Plan) -> Any:
    """The trial's value of a setting."""
    dimension = plan.tune.space[name]
    if dimension.choices:
        choices = [label(value) for value in dimension.choices]
        return dimension.choices[choices.index(trial.suggest_categorical(name, choices))]
    low, high, step, log = dimension.low, dimension.high, dimension.step, dimension.log
    assert low is not None
    assert high is not None
    if plan.is_whole(name):
        return trial.suggest_int(name, int(low), int(high), step=1 if step is None else int(step), log=log)
    return trial.suggest_float(name, float(low), float(high), step=step, log=log)


def work(
    settings: Config,
    tune: Tune,
    observations: Sequence[Path],
    worker: int,
    device: str,
    output: Path,
    root: Path = Path(),
    done: Callable[[int, str], None] = lambda number, text: print(f"trial {number}: {text}", flush=True),
) -> None:
    """Run trials until the sweep has `tune.trials`, or others run the last ones; then write `output`, a JSON record.

    The sweep lies in `output`'s folder. `observations` are those of its scenarios, in this order. Raises InputError.
    """
    from neuspring.core.device import resolve_device

    if not 0 <= worker < tune.workers:
        raise InputError("--worker", f"0 to tune.workers - 1 = {tune.workers - 1} is required", worker)
    plan, folder, device = Plan.of(settings, tune, root), output.parent, resolve_device(device)
    scenes = [Scene.of(path, plan.base["fit"]["tail_fraction"], folder / "frames") for path in observations]
    required, names = list(tune.scenarios or settings.scenarios), [scene.name for scene in scenes]
    if names != required:
        raise InputError("--observations", f"those of {', '.join(required)} are required", ", ".join(names))
    first = labels({name: value for name, value in plan.baseline.items() if holds(tune.space[name], value)})
    sampler = functools.partial(sampler_of, tune, grouped=len(first) < len(tune.space))
    facts = plan.facts() | {"frames": {scene.name: scene.digest for scene in scenes}}
    study = study_of(folder, tune, facts, pruner_of(tune, len(scenes), plan.epochs))
    finished: list[int] = []
    try:
        with FileLock(folder / f".worker-{worker}.lock", timeout=0):
            while True:
                with lock_of(folder):
                    trial = claim(study, worker, tune, first, sampler)
                if trial is None:
                    break
                outcome = _attempt(study, trial, plan, scenes, folder, device)
                finished.append(origin(trial))
                done(finished[-1], outcome)
    except Timeout as error:
        rule = "one process at a time may be this worker"
        raise InputError("--worker", rule, worker, "Wait for the other one to end.") from error
    content = {"study": tune.study, "worker": worker, "trials": finished, "ended": now(), "device": device}
    content |= {"format": RECORD_FORMAT, "host": socket.gethostname()}
    write_text(output, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _attempt(study: Study, trial: Trial, plan: Plan, scenes: Sequence[Scene], folder: Path, device: str) -> str:
    """Run a trial and tell Optuna how it ended; returns that as text. Raises errors that say nothing about its settings."""
    number, started = origin(trial), now()
    outcome = Outcome()

    def report(step: int, loss: float, what: str) -> None:
        trial.report(loss, step)
        if trial.should_prune():
            raise optuna.TrialPruned(f"{what}: {loss:.3e} m^2")

    def tell(state: TrialState, value: float | None = None, reason: str = "") -> None:
        facts = {"started": started, "ended": now(), "losses": outcome.losses, "seconds": outcome.seconds, "device": device}
        codes = provenance.code_digest("neuspring.twin.fit", "neuspring.twin.search")
        trial.set_user_attr(FACTS, facts | {"commit": provenance.commit(), "code": codes})
        if reason:
            trial.set_user_attr(REASON, reason)
        study.tell(trial, value, state=state)
        for scene in scenes:
            checkpoint(folder, number, scene.name).unlink(missing_ok=True)

    try:
        values = _values(trial, plan)
        run(plan, values, scenes, folder, number, device, report, outcome)
        tell(TrialState.COMPLETE, outcome.value)
        return f"{outcome.value:.3e} m^2"
    except optuna.TrialPruned as cut:
        tell(TrialState.PRUNED, reason=str(cut))
        return f"pruned at {cut}"
    except (NumericalFailure, InputError) as failure:
        # A folder that cannot be written is no fault of these settings.
        tempfile.TemporaryFile(dir=folder).close()
        tell(TrialState.FAIL, reason=str(failure))
        return f"failed: {failure}"


def _values(trial: Trial, plan: Plan) -> dict[str, Any]:
    """Setting -> value of a trial; trial 0 is the baseline, whatever the space."""
    space = plan.tune.space
    if origin(trial) == 0:
        values = plan.baseline
        for name, value in values.items():
            if holds(space[name], value):
                suggest(trial, name, plan)
    else:
        values = {name: suggest(trial, name, plan) for name in space}
    trial.set_user_attr(VALUES, values)
    return values
