"""A worker of a sweep, which is one job of the workflow: it runs trials until the sweep has the configured number.

Workers share an Optuna study in SQLite or PostgreSQL, so they may use different GPUs or machines. Optuna's heartbeat finds trials
whose worker was killed, and queues them again.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from filelock import FileLock
from optuna.pruners import BasePruner, MedianPruner, WilcoxonPruner
from optuna.samplers import TPESampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.study import MaxTrialsCallback, Study
from optuna.trial import TrialState

from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core import provenance
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, canonical, now
from neuspring.extensions.tuning.space import SWEEP_SEED, Plan
from neuspring.extensions.tuning.trial import TrainingScene, value_of

DATABASE = "optuna.db"
DEFINITION = "definition"
"""Attribute of the study with the facts that must not change during the sweep."""
FINISHED_STATES = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)
HEARTBEAT = 60
"""Interval of heartbeats, s. Another worker repeats a trial that had none for twice this time."""


def study_of(folder: Path, tune: Tune, facts: Mapping[str, Any], *, begin: bool = False) -> Study:
    """The study of a sweep, from SQLite in its folder or from PostgreSQL; `begin` creates a missing study.

    Raises InputError if the sweep has not begun, or if it began with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    uri = tune.storage or sqlalchemy.URL.create("sqlite", database=str((folder / DATABASE).resolve())).render_as_string()
    # A server may close idle connections during a long fit. SQLite waits for other writers.
    engine = {"pool_pre_ping": True} if tune.storage else {"connect_args": {"timeout": 60}}
    begun = {}
    if begin or tune.storage or (folder / DATABASE).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        # Several processes must not create the tables at the same time.
        with FileLock(folder / ".lock"):
            retry = RetryHeartbeatStaleTrialCallback(max_retry=5)
            try:
                storage = RDBStorage(uri, engine, heartbeat_interval=HEARTBEAT, heartbeat_stale_trial_callback=retry)
            except ImportError as error:
                raise InputError("tune.storage", "PostgreSQL needs a driver", error, "pip install psycopg2-binary") from error
            study = optuna.create_study(storage=storage, study_name=tune.study, load_if_exists=True)
            if begin and DEFINITION not in study.user_attrs:
                study.set_user_attr(DEFINITION, dict(facts))
        begun = study.user_attrs.get(DEFINITION, {})
    if not begun:
        raise InputError(f"sweep {tune.study}", "must have begun", None, "First run neuspring tune.")
    if changed := [name for name, value in facts.items() if canonical(begun.get(name)) != canonical(value)]:
        remedy = f"Set another name in tune.study, or delete this sweep{'' if tune.storage else f' ({folder})'}."
        raise InputError(f"sweep {tune.study}", "must continue with its first settings", f"another {', '.join(changed)}", remedy)
    return study


def pruner_of(scenarios: int) -> BasePruner:
    """The median rule over epochs for one scenario; for several, a test of their losses against those of the best trial."""
    return MedianPruner(n_startup_trials=10, n_warmup_steps=5) if scenarios == 1 else WilcoxonPruner()


def work(
    settings: Config, tune: Tune, observations: Sequence[Path], worker: int, device: str, output: Path, root: Path = Path()
) -> None:
    """Run trials until the sweep has `tune.trials`, with those of other workers; then write `output`, a JSON record.

    The sweep is in the folder of `output`. `observations` has one file per scenario, in their order. Raises InputError.
    """
    if not 0 <= worker < tune.workers:
        raise InputError("--worker", f"must be 0 to tune.workers - 1 = {tune.workers - 1}", worker)
    plan, folder, device = Plan.of(settings, tune, root), output.parent, resolve_device(device)
    scenes = [TrainingScene.of(path, folder / "frames") for path in observations]
    if (names := [scene.name for scene in scenes]) != list(settings.scenarios):
        raise InputError("--observations", f"must be those of {', '.join(settings.scenarios)}", ", ".join(names))
    study = study_of(folder, tune, plan.facts() | {"frames": {scene.name: scene.digest for scene in scenes}}, begin=True)
    made = len(study.get_trials(deepcopy=False))
    if not made:
        study.enqueue_trial(plan.baseline, skip_if_exists=True)
    study.pruner = pruner_of(len(scenes))
    # The seed depends on finished trials, so that a resumed sweep does not repeat its first values.
    study.sampler = TPESampler(seed=SWEEP_SEED + 1000 * worker + made, multivariate=True, constant_liar=True)
    code = provenance.code_digest("neuspring.twin.fit", "neuspring.twin.search")

    def objective(trial: optuna.Trial) -> float:
        trial.set_user_attr("code", code)
        try:
            return value_of(trial, plan, scenes, folder, device)
        except (NumericalFailure, InputError) as error:
            trial.set_user_attr("reason", str(error))
            raise

    if len(study.get_trials(deepcopy=False, states=FINISHED_STATES)) < tune.trials:
        enough = MaxTrialsCallback(tune.trials, states=FINISHED_STATES)
        study.optimize(objective, callbacks=[enough], catch=(NumericalFailure, InputError))
    content = {"study": tune.study, "worker": worker, "ended": now(), "device": device, "format": RECORD_FORMAT}
    write_text(output, json.dumps(content, indent=1, sort_keys=True) + "\n")
