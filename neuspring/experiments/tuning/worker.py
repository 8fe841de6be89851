"""One worker of a sweep, a job of the workflow: it runs trials until the sweep has as many as configured.

Workers share the sweep's storage, so each may be on another GPU or machine. Trials are judged on a tail of the training frames. The
sampler is seeded for every slot by itself: a sweep of one worker that was killed and continued finds what it would have found in
one go.
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
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from filelock import FileLock, Timeout
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import BaseSampler, TPESampler
from optuna.trial import FrozenTrial, Trial, TrialState

from neuspring.config import Config
from neuspring.config.tuning import Dimension, Tune
from neuspring.core import provenance
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, now
from neuspring.experiments.tuning.records import FACTS, VALUES, label, labels, write_trial
from neuspring.experiments.tuning.space import Plan, holds, is_whole
from neuspring.experiments.tuning.store import CRASH, DEFINITION, REASON, SLOT, Store, claim, slots
from neuspring.experiments.tuning.trial import Outcome, Scene, checkpoint, run

if TYPE_CHECKING:
    from optuna.study import Study


def sampler_of(tune: Tune, slot: int, *, grouped: bool) -> BaseSampler:
    """TPE with the seed of a slot. `grouped`: the baseline has values that the space cannot hold, so that its trial lacks them."""
    seed = int.from_bytes(hashlib.sha256(f"{tune.seed} {slot}".encode()).digest()[:4], "big")
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
    unpruned = tune.warmup_scenarios
    if unpruned is None:
        unpruned = math.ceil(scenarios / 3) if scenarios > 1 else 0
    warmup = unpruned * epochs + tune.warmup_epochs
    if tune.pruner == "hyperband":
        return HyperbandPruner(min_resource=max(warmup, 1), max_resource=max(scenarios * epochs, warmup, 1))
    return MedianOfStep(tune, warmup) if tune.pruner == "median" else NopPruner()


def suggest(trial: Trial, name: str, dimension: Dimension) -> Any:
    """The trial's value of a setting."""
    if dimension.choices:
        choices = [label(value) for value in dimension.choices]
        return dimension.choices[choices.index(trial.suggest_categorical(name, choices))]
    low, high, step, log = dimension.low, dimension.high, dimension.step, dimension.log
    assert low is not None
    assert high is not None
    if is_whole(name):
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
    done: Callable[[int, str], None] = lambda slot, text: print(f"trial {slot}: {text}", flush=True),
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
    store = Store(folder, tune.storage, tune.study)
    study = store.open(facts, pruner_of(tune, len(scenes), plan.epochs))
    finished: list[int] = []
    with _only(folder, worker):
        while True:
            with store.lock():
                trial = claim(study, worker, tune, first, sampler)
            if trial is None:
                break
            slot = trial.user_attrs[SLOT]
            outcome = _attempt(study, trial, plan, scenes, folder, device)
            write_trial(plan, study.user_attrs[DEFINITION], slots(study)[slot], folder)
            finished.append(slot)
            done(slot, outcome)
    content = {"study": tune.study, "worker": worker, "slots": finished, "ended": now(), "device": device}
    content |= {"format": RECORD_FORMAT, "host": socket.gethostname()}
    write_text(output, json.dumps(content, indent=1, sort_keys=True) + "\n")


@contextlib.contextmanager
def _only(folder: Path, worker: int) -> Iterator[None]:
    """Be the only process with this number. Raises InputError if there is another."""
    try:
        with FileLock(folder / f".worker-{worker}.lock", timeout=0):
            yield
    except Timeout as error:
        raise InputError(
            "--worker", "one process at a time may be this worker", worker, "Wait for the other one to end."
        ) from error


def _attempt(study: Study, trial: Trial, plan: Plan, scenes: Sequence[Scene], folder: Path, device: str) -> str:
    """Run a trial and tell Optuna how it ended; returns that as text. Raises errors that say nothing about its settings."""
    slot, started = trial.user_attrs[SLOT], now()
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
            checkpoint(folder, slot, scene.name).unlink(missing_ok=True)

    try:
        values = _values(trial, plan)
        run(plan, values, scenes, folder, slot, device, report, outcome)
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
    except Exception as crash:
        with contextlib.suppress(Exception):
            trial.set_user_attr(CRASH, f"{type(crash).__name__}: {crash}"[:500])
            study.tell(trial, state=TrialState.FAIL)
        raise


def _values(trial: Trial, plan: Plan) -> dict[str, Any]:
    """Setting -> value of a trial; slot 0 is the baseline, whatever the space."""
    space = plan.tune.space
    if trial.user_attrs[SLOT] == 0:
        values = plan.baseline
        for name, value in values.items():
            if holds(space[name], value):
                suggest(trial, name, space[name])
    else:
        values = {name: suggest(trial, name, dimension) for name, dimension in space.items()}
    trial.set_user_attr(VALUES, values)
    return values
