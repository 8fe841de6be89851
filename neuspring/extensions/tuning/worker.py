"""One worker of a sweep, a job of the workflow: it runs trials until the sweep has as many as configured.

Workers share an Optuna study, in SQLite or PostgreSQL, so each may be on another GPU or machine. Those that look at the count at
the same time may make a trial more each than were asked for. When a killed worker starts again, the trial that it left is queued
anew with its values, so that its fits continue from their checkpoints. (Optuna's own callback for that is experimental, and waits
until a heartbeat is missed.)
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
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from filelock import FileLock, Timeout
from optuna.pruners import BasePruner, MedianPruner
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
from neuspring.extensions.tuning.space import SWEEP_SEED, Plan, holds, label, labels
from neuspring.extensions.tuning.trial import TrainingScene, TrialOutcome, checkpoint, run

DATABASE = "optuna.db"
DEFINITION = "definition"
"""Attribute of the study: what must not change while it lasts."""
ORIGIN, WORKER, REASON = "origin", "worker", "reason"
"""Attributes of a trial: the number of the one that it continues, its worker, why it ended early (unless it was left behind)."""
TRIAL_FACTS, VALUES = "facts", "values"
"""Attributes of a trial: how it went, and its values. The baseline's include those that the space cannot hold."""
MOST_DEATHS = 5
"""A trial that ends its worker this often is not continued; another takes its place."""
STARTUP_TRIALS = 10
"""Random trials, before the sampler learns from earlier ones, and finished ones before the median prunes any."""
WARMUP_EPOCHS = 5
"""Epochs in which no trial is pruned."""
WRITER_PATIENCE = 60.0
"""Seconds that SQLite waits for another writer."""


def lock_of(folder: Path) -> FileLock:
    """Holds the sweep in `folder` against its other workers; the death of the holder frees it."""
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".lock")


def study_of(folder: Path, tune: Tune, facts: Mapping[str, Any], pruner: BasePruner | None = None) -> Study:
    """A sweep, which is made if there is none and it is given a `pruner`; it is kept in SQLite in its folder, or in PostgreSQL.

    Raises InputError if there is none, or if it was begun with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path, begun = folder / DATABASE, None
    uri = tune.storage or sqlalchemy.URL.create("sqlite", database=str(path.resolve())).render_as_string()
    # A server may close connections that are idle during a long fit.
    engine = {"pool_pre_ping": True} if tune.storage else {"connect_args": {"timeout": WRITER_PATIENCE}}
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


def origin(trial: FrozenTrial) -> int:
    """The number of the trial that it continues; its own if none. Trial 0 is the baseline."""
    return int(trial.user_attrs.get(ORIGIN, trial.number))


def counted(study: Study) -> list[FrozenTrial]:
    """The trials that count, by origin: finished, pruned, running, failed by their settings, or to be continued."""
    trials = study.get_trials(deepcopy=False)

    def counts(trial: FrozenTrial) -> bool:
        # One that runs and has no worker was begun at this moment, or by a process that died at that moment.
        running = trial.state == TrialState.RUNNING and WORKER in trial.user_attrs
        return running or trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or REASON in trial.user_attrs

    return sorted([*filter(counts, trials), *_left(trials)], key=origin)


def _left(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Trials that ended with their worker, which none continues yet; not those that did so too often."""
    newest, times = {origin(trial): trial for trial in trials}, Counter(map(origin, trials))
    ended = [trial for trial in newest.values() if trial.state == TrialState.FAIL and REASON not in trial.user_attrs]
    return [trial for trial in ended if times[origin(trial)] < MOST_DEATHS]


def continue_left(study: Study, worker: int, tune: Tune, first: Mapping[str, Any]) -> None:
    """Queue anew the trials that earlier processes of this worker left, or workers that the configuration no longer has.

    `first` are the values of the baseline.
    """

    def concerns(trial: FrozenTrial) -> bool:
        owner = trial.user_attrs.get(WORKER, worker if tune.workers == 1 else -1)
        return bool(owner == worker or owner >= tune.workers)

    for trial in filter(concerns, study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))):
        study.tell(trial.number, state=TrialState.FAIL)
    for trial in filter(concerns, _left(study.get_trials(deepcopy=False))):
        values = (dict(first) if origin(trial) == 0 else {}) | trial.params
        study.enqueue_trial(values, user_attrs={ORIGIN: origin(trial)})


def sampler_of(count: int, *, grouped: bool) -> BaseSampler:
    """TPE with a seed of its own behind `count` trials. `grouped`: the baseline's trial lacks values that the space cannot hold."""
    seed = int.from_bytes(hashlib.sha256(f"{SWEEP_SEED} {count}".encode()).digest()[:4], "big")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return TPESampler(seed=seed, n_startup_trials=STARTUP_TRIALS, multivariate=True, group=grouped, constant_liar=True)


class MedianOfStep(BasePruner):
    """Optuna's median rule, on the last value alone: losses at different steps are of different scenarios."""

    def __init__(self, warmup: int) -> None:
        self._inner = MedianPruner(n_startup_trials=STARTUP_TRIALS, n_warmup_steps=warmup)

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """True where the trial is above the median of completed ones at its last step."""
        if trial.last_step is None:
            return False
        last = copy.copy(trial)
        last.intermediate_values = {trial.last_step: trial.intermediate_values[trial.last_step]}
        return self._inner.prune(study, last)


def pruner_of(scenarios: int, epochs: int) -> MedianOfStep:
    """The pruner of a sweep whose trials have at most `epochs` steps for each of its scenarios.

    Of several scenarios every trial first runs a third to their end: the loss of one alone says little about the mean.
    """
    unpruned = math.ceil(scenarios / 3) if scenarios > 1 else 0
    return MedianOfStep(unpruned * epochs + WARMUP_EPOCHS)


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
    scenes = [TrainingScene.of(path, folder / "frames") for path in observations]
    required, names = list(settings.scenarios), [scene.name for scene in scenes]
    if names != required:
        raise InputError("--observations", f"those of {', '.join(required)} are required", ", ".join(names))
    first = labels({name: value for name, value in plan.baseline.items() if holds(tune.space[name], value)})
    sampler = functools.partial(sampler_of, grouped=len(first) < len(tune.space))
    facts = plan.facts() | {"frames": {scene.name: scene.digest for scene in scenes}}
    study = study_of(folder, tune, facts, pruner_of(len(scenes), plan.epochs))
    finished: list[int] = []

    def objective(trial: Trial) -> float:
        trial.set_user_attr(WORKER, worker)
        number = origin(study.get_trials(deepcopy=False)[trial.number])
        return _attempt(trial, number, plan, scenes, folder, device)

    def told(study: Study, trial: FrozenTrial) -> None:
        finished.append(origin(trial))
        words = {TrialState.COMPLETE: "{:.3e} m^2", TrialState.PRUNED: "pruned at {1}", TrialState.FAIL: "failed: {1}"}
        done(finished[-1], words[trial.state].format(trial.value, trial.user_attrs.get(REASON)))

    try:
        with FileLock(folder / f".worker-{worker}.lock", timeout=0):
            continue_left(study, worker, tune, first)
            if not study.get_trials(deepcopy=False):
                study.enqueue_trial(first, skip_if_exists=True)
            waiting = (TrialState.WAITING,)
            while (count := len(counted(study))) < tune.trials or study.get_trials(deepcopy=False, states=waiting):
                study.sampler = sampler(count)
                study.optimize(objective, n_trials=1, catch=(NumericalFailure, InputError), callbacks=[told])
    except Timeout as error:
        rule = "one process at a time may be this worker"
        raise InputError("--worker", rule, worker, "Wait for the other one to end.") from error
    content = {"study": tune.study, "worker": worker, "trials": finished, "ended": now(), "device": device}
    content |= {"format": RECORD_FORMAT, "host": socket.gethostname()}
    write_text(output, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _attempt(trial: Trial, number: int, plan: Plan, scenes: Sequence[TrainingScene], folder: Path, device: str) -> float:
    """Run a trial: its value. Raises what Optuna takes as pruned or failed, and errors that say nothing about its settings."""
    started, outcome = now(), TrialOutcome()

    def report(step: int, loss: float, what: str) -> None:
        trial.report(loss, step)
        if trial.should_prune():
            raise optuna.TrialPruned(f"{what}: {loss:.3e} m^2")

    try:
        run(plan, _values(trial, number, plan), scenes, folder, number, device, report, outcome)
    except (optuna.TrialPruned, NumericalFailure, InputError) as error:
        # A folder that cannot be written is no fault of these settings.
        tempfile.TemporaryFile(dir=folder).close()
        trial.set_user_attr(REASON, str(error))
        raise
    finally:
        facts = {"started": started, "ended": now(), "losses": outcome.losses, "seconds": outcome.seconds, "device": device}
        codes = provenance.code_digest("neuspring.twin.fit", "neuspring.twin.search")
        trial.set_user_attr(TRIAL_FACTS, facts | {"commit": provenance.commit(), "code": codes})
    for scene in scenes:
        checkpoint(folder, number, scene.name).unlink(missing_ok=True)
    return outcome.value


def _values(trial: Trial, number: int, plan: Plan) -> dict[str, Any]:
    """Setting -> value of a trial; trial 0 is the baseline, whatever the space."""
    space = plan.tune.space
    if number == 0:
        values = plan.baseline
        for name, value in values.items():
            if holds(space[name], value):
                suggest(trial, name, plan)
    else:
        values = {name: suggest(trial, name, plan) for name in space}
    trial.set_user_attr(VALUES, values)
    return values
