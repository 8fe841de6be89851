"""Tuning: Optuna studies over settings of one method, by any number of workers, judged on held-back training frames.

`work` is one worker, a job of the workflow; `report` sums the study up. Workers share the study's storage, so
each may be on another GPU or machine. The sampler is seeded for every slot by itself: a study of one worker that was killed and
continued finds what it would have found in one go.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import math
import socket
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
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
from neuspring.experiments.tuning.store import CRASH, DEFINITION, REASON, SLOT, Store, claim, slots, worker_lock
from neuspring.experiments.tuning.trial import Outcome, Scene, checkpoint, run

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.study import Study


class Seeded(BaseSampler):
    """TPE with a seed of its own for every slot."""

    def __init__(self, tune: Tune, *, grouped: bool) -> None:
        """`grouped`: some trial, the baseline, lacks values that the space cannot hold."""
        self._tune, self._grouped = tune, grouped
        self._inner = self._made(0)

    def _made(self, slot: int) -> TPESampler:
        seed = int.from_bytes(hashlib.sha256(f"{self._tune.seed} {slot}".encode()).digest()[:4], "big")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return TPESampler(
                seed=seed, n_startup_trials=self._tune.startup_trials, multivariate=True, group=self._grouped, constant_liar=True
            )

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        self._inner = self._made(trial.user_attrs[SLOT])

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return self._inner.infer_relative_search_space(study, trial)

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]) -> dict[str, Any]:
        return self._inner.sample_relative(study, trial, search_space)

    def sample_independent(self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution) -> Any:
        return self._inner.sample_independent(study, trial, param_name, param_distribution)


class MedianOfStep(BasePruner):
    """Optuna's median rule on the last value alone: losses of different scenarios, at different steps, cannot be compared."""

    def __init__(self, tune: Tune, warmup: int) -> None:
        # Of no finished trial there is no median.
        self._inner = MedianPruner(n_startup_trials=max(tune.startup_trials, 1), n_warmup_steps=warmup)

    def prune(self, study: Study, trial: FrozenTrial) -> bool:
        """Whether the trial is above the median of completed ones at its last step."""
        if trial.last_step is None:
            return False
        last = copy.copy(trial)
        last.intermediate_values = {trial.last_step: trial.intermediate_values[trial.last_step]}
        return self._inner.prune(study, last)


def pruner_of(tune: Tune, scenarios: int, epochs: int) -> BasePruner:
    """The pruner of a study whose trials have at most `epochs` steps for each of its scenarios."""
    whole = tune.warmup_scenarios
    if whole is None:
        whole = math.ceil(scenarios / 3) if scenarios > 1 else 0
    warmup = whole * epochs + tune.warmup_epochs
    if tune.pruner == "hyperband":
        return HyperbandPruner(min_resource=max(warmup, 1), max_resource=max(scenarios * epochs, warmup, 1))
    return MedianOfStep(tune, warmup) if tune.pruner == "median" else NopPruner()


def suggest(trial: Trial, name: str, dimension: Dimension) -> Any:
    """The trial's value of a setting."""
    if dimension.choices:
        known = [label(value) for value in dimension.choices]
        return dimension.choices[known.index(trial.suggest_categorical(name, known))]
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
    """Run trials until the study has `tune.trials`, or others run the last ones; then write `output`, a JSON record.

    The study lies in `output`'s folder. `observations` are those of the study's scenarios, in this order. Raises InputError.
    """
    from neuspring.core.device import resolve_device

    if not 0 <= worker < tune.workers:
        raise InputError("--worker", f"0 to tune.workers - 1 = {tune.workers - 1} is required", worker)
    plan, folder, device = Plan.of(settings, tune, root), output.parent, resolve_device(device)
    store = Store(folder, tune.storage, tune.study)
    scenes = [Scene.of(path, plan.base["fit"]["tail_fraction"], folder / "frames") for path in observations]
    wanted = list(tune.scenarios or settings.scenarios)
    if [scene.name for scene in scenes] != wanted:
        raise InputError("--observations", f"those of {', '.join(wanted)} are required", ", ".join(scene.name for scene in scenes))
    first = labels({name: value for name, value in plan.baseline.items() if holds(tune.space[name], value)})
    sampler = Seeded(tune, grouped=len(first) < len(tune.space))
    facts = plan.facts() | {"frames": {scene.name: scene.digest for scene in scenes}}
    study = store.open(facts, sampler, pruner_of(tune, len(scenes), plan.epochs))
    mine: list[int] = []
    if not store.locks.is_free(worker_lock(worker)):
        print(f"waiting for another process that is worker {worker} of study {tune.study}", flush=True)
    with store.locks.hold(worker_lock(worker)):
        while trial := claim(study, store.locks, worker, tune.trials, first):
            slot = trial.user_attrs[SLOT]
            finished = _attempt(study, trial, plan, scenes, folder, device)
            write_trial(plan, study.user_attrs[DEFINITION], slots(study)[slot], folder)
            mine.append(slot)
            done(slot, finished)
    content = {"study": tune.study, "worker": worker, "slots": mine, "ended": now(), "device": device, "host": socket.gethostname()}
    write_text(output, json.dumps({"format": RECORD_FORMAT, **content}, indent=1, sort_keys=True) + "\n")


def _attempt(study: Study, trial: Trial, plan: Plan, scenes: Sequence[Scene], folder: Path, device: str) -> str:
    """Run a trial and tell the study how it ended; returns that as text. What is no result of its settings raises."""
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
