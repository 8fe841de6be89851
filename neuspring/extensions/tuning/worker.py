"""One worker of a sweep, a job of the workflow: it runs trials until the sweep has as many as configured.

Workers share an Optuna study, in SQLite or PostgreSQL, so each may be on another GPU or machine. Those that look at the count at
the same time may make a trial more each than were asked for. When a killed worker starts again, Optuna queues the trial that it
left anew, and its fits continue from their checkpoints. (Optuna's heartbeat would find such a trial too, but only after a grace
period in which a sweep of one worker has gone on with other trials.)
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import shutil
import socket
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from filelock import FileLock, Timeout
from optuna.pruners import BasePruner, MedianPruner
from optuna.samplers import BaseSampler, TPESampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
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
from neuspring.extensions.tuning.trial import TrainingScene, run

DATABASE = "optuna.db"
DEFINITION = "definition"
"""Attribute of the study: what must not change while it lasts."""
WORKER, REASON = "worker", "reason"
"""Attributes of a trial: its worker; why it was pruned or failed."""
TRIAL_FACTS, VALUES = "facts", "values"
"""Attributes of a trial: how it was made, and its values. The baseline's include those that the space cannot hold."""
MOST_DEATHS = 5
"""A trial that ends its worker this often is not continued; another takes its place."""
STARTUP_TRIALS = 10
"""Random trials, before the sampler learns from earlier ones, and finished ones before the median prunes any."""
WARMUP_EPOCHS = 5
"""Epochs in which no trial is pruned."""
WRITER_PATIENCE = 60.0
"""Seconds that SQLite waits for another writer."""


def study_of(folder: Path, tune: Tune, facts: Mapping[str, Any], *, begin: bool = False) -> Study:
    """A sweep, which is kept in SQLite in its folder, or in PostgreSQL. `begin`: make it if there is none.

    Raises InputError if there is none, or if it was begun with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path, begun = folder / DATABASE, None
    uri = tune.storage or sqlalchemy.URL.create("sqlite", database=str(path.resolve())).render_as_string()
    # A server may close connections that are idle during a long fit.
    engine = {"pool_pre_ping": True} if tune.storage else {"connect_args": {"timeout": WRITER_PATIENCE}}
    if begin or tune.storage or path.is_file():
        # Several processes must not create the tables at once.
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock"):
            try:
                storage = RDBStorage(uri, engine_kwargs=engine)
            except ImportError as error:
                raise InputError("tune.storage", "PostgreSQL needs a driver", error, "pip install psycopg2-binary") from error
            study = optuna.create_study(storage=storage, study_name=tune.study, load_if_exists=True)
            if begin and DEFINITION not in study.user_attrs:
                study.set_user_attr(DEFINITION, dict(facts))
        begun = study.user_attrs.get(DEFINITION)
    if begun is None:
        raise InputError(f"sweep {tune.study}", "must have been begun", None, "Run neuspring tune first.")
    before, after = flat({name: begun.get(name) for name in facts}), flat(facts)
    if canonical(before) != canonical(after):
        changed = [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]
        remedy = f"Name a new sweep (tune.study), or delete this one{'' if tune.storage else f' ({folder})'}."
        rule = "must go on with what it was begun with"
        raise InputError(f"sweep {tune.study}", rule, f"another {', '.join(changed)}", remedy)
    return study


def origin(trial: FrozenTrial) -> int:
    """The number of the trial that it continues, as Optuna's callback notes it; its own if none. Trial 0 is the baseline."""
    return int(trial.system_attrs.get("failed_trial", trial.number))


def counted(study: Study) -> list[FrozenTrial]:
    """The trials that count, by origin: finished, pruned, running, failed by their settings, or to be continued."""

    def counts(trial: FrozenTrial) -> bool:
        # One that runs and has no worker was begun at this moment, or by a process that died at that moment.
        held = trial.state in (TrialState.RUNNING, TrialState.WAITING) and WORKER in trial.user_attrs
        return held or trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or REASON in trial.user_attrs

    return sorted(filter(counts, study.get_trials(deepcopy=False)), key=origin)


def continue_left(study: Study, worker: int, tune: Tune) -> None:
    """Queue anew the trials that earlier processes of this worker left, or workers that the configuration no longer has."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        queue_anew = RetryHeartbeatStaleTrialCallback(max_retry=MOST_DEATHS - 1)
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        owner = trial.user_attrs.get(WORKER, worker if tune.workers == 1 else -1)
        if owner == worker or owner >= tune.workers:
            study.tell(trial.number, state=TrialState.FAIL)
            # One with a reason ended just before its worker.
            if REASON not in trial.user_attrs:
                queue_anew(study, trial)


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
    study = study_of(folder, tune, plan.facts() | {"frames": {scene.name: scene.digest for scene in scenes}}, begin=True)
    study.pruner = pruner_of(len(scenes), plan.epochs)
    finished: list[int] = []
    try:
        with FileLock(folder / f".worker-{worker}.lock", timeout=0):
            continue_left(study, worker, tune)
            if not study.get_trials(deepcopy=False):
                study.enqueue_trial(first, skip_if_exists=True)
            waiting = (TrialState.WAITING,)
            while (count := len(counted(study))) < tune.trials or study.get_trials(deepcopy=False, states=waiting):
                study.sampler = sampler_of(count, grouped=len(first) < len(tune.space))
                trial = study.ask()
                trial.set_user_attr(WORKER, worker)
                finished.append(origin(study.get_trials(deepcopy=False)[trial.number]))
                done(finished[-1], _attempt(trial, finished[-1], plan, scenes, folder, device))
    except Timeout as error:
        rule = "one process at a time may be this worker"
        raise InputError("--worker", rule, worker, "Wait for the other one to end.") from error
    content = {"study": tune.study, "worker": worker, "trials": finished, "ended": now(), "device": device}
    content |= {"format": RECORD_FORMAT, "host": socket.gethostname()}
    write_text(output, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _attempt(trial: Trial, number: int, plan: Plan, scenes: Sequence[TrainingScene], folder: Path, device: str) -> str:
    """Run a trial and tell the study how it ended; returns that in words. Raises errors that say nothing about its settings.

    Such an error leaves the trial as the death of this process does: running, to be continued.
    """

    def report(step: int, loss: float, what: str) -> None:
        trial.report(loss, step)
        if trial.should_prune():
            raise optuna.TrialPruned(f"{what}: {loss:.3e} m^2")

    losses: dict[str, float] = {}
    state, reason = TrialState.COMPLETE, ""
    try:
        run(plan, _values(trial, number, plan), scenes, folder, number, device, report, losses)
    except (optuna.TrialPruned, NumericalFailure, InputError) as error:
        # A folder that cannot be written is no fault of these settings.
        tempfile.TemporaryFile(dir=folder).close()
        state = TrialState.PRUNED if isinstance(error, optuna.TrialPruned) else TrialState.FAIL
        reason = str(error)
        trial.set_user_attr(REASON, reason)
    codes = provenance.code_digest("neuspring.twin.fit", "neuspring.twin.search")
    trial.set_user_attr(TRIAL_FACTS, {"losses": losses, "device": device, "commit": provenance.commit(), "code": codes})
    # The mean over scenarios.
    value = sum(losses.values()) / len(losses) if state == TrialState.COMPLETE else None
    trial.study.tell(trial, value, state)
    shutil.rmtree(folder / "trials" / str(number), ignore_errors=True)
    return f"{state.name.lower()}: {reason or f'{value:.3e} m^2'}"


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
