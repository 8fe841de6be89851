"""The report of a sweep, finished or not: Optuna's table of trials, the best trial as a configuration, and a summary.

The sweep's storage is the only input. The summary is written last. `optuna-dashboard` draws figures of the storage.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.trial import FrozenTrial, TrialState

from neuspring import config
from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.extensions.tuning.space import Plan, section_of
from neuspring.extensions.tuning.worker import FINISHED_STATES, study_of


def report(settings: Config, tune: Tune, output: Path, root: Path = Path()) -> None:
    """Summarize the sweep in the folder of `output`, finished or not. Raises InputError if there is none."""
    plan, folder = Plan.of(settings, tune, root), output.parent
    study = study_of(folder, tune, plan.facts())
    write_text(folder / "trials.csv", study.trials_dataframe().to_csv(index=False))
    done = sorted(study.get_trials(states=(TrialState.COMPLETE,)), key=lambda trial: trial.value or 0.0)
    counts = [len(study.get_trials(deepcopy=False, states=(state,))) for state in FINISHED_STATES]
    lines = [
        f"# Sweep {tune.study}: {tune.method} tuned",
        "{1} of {0} trials: {2} complete, {3} pruned, {4} failed.".format(tune.trials, sum(counts), *counts),
        "The value, m², is the loss on the tail of the training frames, which neither search nor fit uses, averaged over "
        f"{', '.join(settings.scenarios)}. Future frames are not read. All trials: `trials.csv`; figures: `optuna-dashboard`.",
    ]
    if done:
        write_best(plan, done[0], folder)
        rows = [[str(t.number), f"{t.value:.4e}", *(_shown(t.params[name]) for name in tune.space)] for t in done[:10]]
        lines += [
            "## Best trials",
            "Trial 0 is the unchanged method. The smallest of many losses on the same few frames is optimistic: compare both "
            f"methods on future frames.\n\n```\nsnakemake ... --configfile <the benchmark's> {folder / 'best.yaml'}\n```",
            _markdown(["Trial", "Value [m²]", *tune.space], rows),
        ]
    if len(done) > 1:
        importance = optuna.importance.get_param_importances(study)
        shares = [[name, f"{share:.2f}"] for name, share in importance.items()]
        lines += ["## Importance of settings (PED-ANOVA)", _markdown(["Setting", "Share of variance"], shares)]
    if failed := study.get_trials(states=(TrialState.FAIL,)):
        reasons = [f"- trial {trial.number}: {trial.user_attrs.get('reason', 'the worker was killed')}" for trial in failed]
        lines += ["## Failed", "\n".join(reasons)]
    write_text(output, "\n\n".join(lines) + "\n")


def write_best(plan: Plan, best: FrozenTrial, folder: Path) -> None:
    """Write best.yaml, a configuration with a new method, and rows.yaml with its entry.

    The new method is the varied method with the best trial's `fit` settings. The trial's `search` settings and `clusters` make a
    new search. All other settings (simulation, losses, quirks) apply to all methods.
    """
    name, method = f"{plan.tune.method}_{plan.tune.study}", plan.tune.method
    description = f"{method}, tuned: trial {best.number} of sweep {plan.tune.study}"
    sections: dict[str, Any] = {}
    for path, value in best.params.items():
        above, key = section_of(sections, path)
        above[key] = value
    fit, search = sections.pop("fit", {}), sections.pop("search", {})
    clusters = sections.pop("clusters", plan.row.clusters)
    tuned = config.plain(plan.method) | {"description": description, "search": name}
    row = config.plain(plan.row) | {"description": description, "clusters": clusters}
    config.merge(tuned["settings"], fit)
    config.merge(row["settings"], search)
    overlay = {"methods": [method, name], "compare_with": method, "tables": f"tables-{name}"} | sections
    # The path is absolute, because relative paths start from the Snakefile.
    overlay["extra_rows"] = {name: str((folder / "rows.yaml").resolve())}
    for file, content in {"best": overlay, "rows": {"methods": {name: tuned}, "searches": {name: row}}}.items():
        write_text(folder / f"{file}.yaml", yaml.safe_dump(content, sort_keys=False, width=120))


def _markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(Table.of_texts(head, rows).markdown())


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
