"""The report of a sweep: trials.csv, the best trial as an overlay, and a summary, which is written last.

Everything is made from the sweep's storage, of a sweep that is finished or not. A trial that continues another has its number.
`optuna-dashboard` draws pictures of the storage.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from optuna.trial import FrozenTrial, TrialState

from neuspring import config
from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.experiments.benchmark import read_methods, read_searches
from neuspring.extensions.tuning.space import CLUSTERS, Plan, labels
from neuspring.extensions.tuning.worker import DEFINITION, REASON, TRIAL_FACTS, VALUES, WORKER, counted, origin, study_of
from neuspring.twin.fit import TAIL_FRACTION

SECTIONS_OF_NO_ROW = ("simulation", "losses", "released_quirks")
"""An overlay sets them for all methods."""


def state(trial: FrozenTrial) -> str:
    """complete, pruned, failed or running; one that is to be continued is running."""
    return {TrialState.FAIL: "failed", TrialState.WAITING: "running"}.get(trial.state, trial.state.name.lower())


def best_of(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The finished trial of least loss; of several, the first."""
    return min((t for t in trials if t.state == TrialState.COMPLETE), key=lambda t: (t.value, origin(t)), default=None)


def report(settings: Config, tune: Tune, output: Path, root: Path = Path()) -> None:
    """Sum up a sweep, finished or not. It lies in `output`'s folder. Raises InputError if there is none."""
    plan, folder = Plan.of(settings, tune, root), output.parent
    study = study_of(folder, tune, plan.facts())
    # Trials beyond a `tune.trials` that was lowered count as well.
    trials, scenes = counted(study), list(study.user_attrs[DEFINITION]["frames"])
    # No file of an earlier report may stay beside this one's.
    for name in ("trials.csv", "best.yaml", "methods.yaml", "searches.yaml"):
        (folder / name).unlink(missing_ok=True)
    table = _table(trials, plan)
    write_text(folder / "trials.csv", table.to_csv(index=False))
    if best := best_of(trials):
        write_best(plan, best, settings, folder, root)
    write_text(output, summary(plan, trials, table, scenes, folder))


def _table(trials: Sequence[FrozenTrial], plan: Plan) -> pd.DataFrame:
    rows = []
    for trial in trials:
        facts = trial.user_attrs.get(TRIAL_FACTS, {})
        row: dict[str, Any] = {"trial": origin(trial), "state": state(trial)}
        row |= {"loss": trial.value if trial.state == TrialState.COMPLETE else math.nan, "reason": trial.user_attrs.get(REASON, "")}
        row |= dict.fromkeys(plan.tune.space) | labels(trial.user_attrs.get(VALUES, {}))
        row |= {f"loss/{name}": value for name, value in facts.get("losses", {}).items()}
        row |= {"started": trial.datetime_start, "ended": trial.datetime_complete, "worker": trial.user_attrs.get(WORKER)}
        rows.append(row | {name: facts.get(name) for name in ("device", "commit", "code")})
    # As objects: null is a value, not a missing number.
    return pd.DataFrame(rows, dtype=object).astype({"trial": int, "loss": float})


def write_best(plan: Plan, best: FrozenTrial, settings: Config, folder: Path, root: Path) -> None:
    """Write best.yaml, an overlay with a new method row, and the tables that it names.

    The new method row is the varied one with the best trial's `fit` settings. Its `search` settings and `clusters` make a new
    search row. Settings that belong to no row (simulation, losses, quirks) are set for all methods.
    """
    values = dict(best.user_attrs[VALUES])
    name, method = tuned_name(plan.tune), plan.tune.method
    description = f"{method}, tuned: trial {origin(best)} of sweep {plan.tune.study}"
    clusters = values.pop(CLUSTERS, None)
    sections: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        *above, key = path.split(".")
        functools.reduce(lambda inside, part: inside.setdefault(part, {}), above, sections)[key] = value
    methods = {key: config.plain(row) for key, row in read_methods(root / settings.method_table).items()}
    searches = {key: config.plain(row) for key, row in read_searches(root / settings.search_table, settings.clusters).items()}
    tuned = config.plain(plan.method) | {"description": description}
    config.merge(tuned["settings"], sections.get("fit", {}))
    if "search" in sections or clusters is not None:
        row = config.plain(plan.row) | {"description": description, "clusters": clusters or plan.row.clusters}
        config.merge(row["settings"], sections.get("search", {}))
        searches[name], tuned["search"] = row, name
    overlay: dict[str, Any] = {"methods": [method, name], "compare_with": method, "tables": f"tables-{name}"}
    # Absolute: relative ones would start from the Snakefile.
    overlay |= {
        f"{table}_table": str((folder / file).resolve())
        for table, file in (("method", "methods.yaml"), ("search", "searches.yaml"))
    }
    overlay |= {section: sections[section] for section in SECTIONS_OF_NO_ROW if section in sections}
    for file, content in {"best.yaml": overlay, "methods.yaml": methods | {name: tuned}, "searches.yaml": searches}.items():
        write_text(folder / file, yaml.safe_dump(content, sort_keys=False, width=120))


def tuned_name(tune: Tune) -> str:
    """The method row of a sweep's best trial."""
    return f"{tune.method}_{tune.study}"


def summary(plan: Plan, trials: Sequence[FrozenTrial], table: pd.DataFrame, scenes: Sequence[str], folder: Path) -> str:
    """The sweep in Markdown."""
    tune, best, shown = plan.tune, best_of(trials), 10
    counts = {name: sum(state(trial) == name for trial in trials) for name in ("complete", "pruned", "failed", "running")}
    running, codes = counts.pop("running"), table["code"].nunique()
    lines = [
        f"# Sweep {tune.study}: {tune.method} tuned",
        f"{sum(counts.values())} of {tune.trials} trials: {counts['complete']} finished, {counts['pruned']} pruned, "
        f"{counts['failed']} failed. {running} more are running, or were left behind by a killed worker.",
        f"The loss, m², is that of the last {TAIL_FRACTION:.0%} of the training frames, which neither "
        f"search nor fit has seen. It is the mean over scenarios: {', '.join(scenes)}. Test frames were not read.",
    ]
    if codes > 1:
        lines += [f"Trials were made by {codes} versions of the code (see trials.csv) and may not be comparable."]
    lines += _best_lines(plan, best, trials, folder) if best else ["No trial has finished, so there is no best one."]
    done = table[table["state"] == "complete"].sort_values(["loss", "trial"]).head(shown).to_dict("records")
    rows = [[str(row["trial"]), f"{row['loss']:.4e}", *(_shown(row[name]) for name in tune.space)] for row in done]
    lines += [
        f"## The best {shown} finished trials",
        _markdown(["Trial", "Loss [m²]", *tune.space], rows),
        "All trials: `trials.csv`.",
    ]
    failed = [f"- trial {origin(trial)}: {trial.user_attrs[REASON]}" for trial in trials if state(trial) == "failed"]
    return "\n\n".join([*lines, *(["## Failed", "\n".join(failed)] if failed else [])]) + "\n"


def _best_lines(plan: Plan, best: FrozenTrial, trials: Sequence[FrozenTrial], folder: Path) -> list[str]:
    baseline = next((trial.value for trial in trials if origin(trial) == 0), None)
    loss = best.value or math.nan
    compared = f"{baseline:.4e} m²; a ratio of {loss / baseline:.3f}" if baseline else "not finished"
    values, unchanged = labels(best.user_attrs[VALUES]), labels(plan.baseline)
    return [
        "## Best",
        f"Trial {origin(best)}: {loss:.4e} m². The unchanged configuration (trial 0): {compared}.",
        "The smallest of many losses on the same few frames is optimistic: compare the two methods on test frames.",
        _markdown(["Setting", "Best", "Unchanged"], [[name, _shown(values[name]), _shown(unchanged[name])] for name in values]),
        f"`{folder / 'best.yaml'}` is an overlay with both as rows, `{plan.tune.method}` and `{tuned_name(plan.tune)}`; settings "
        f"of {', '.join(SECTIONS_OF_NO_ROW)} belong to no row, and it sets them for both:",
        f"```\nsnakemake ... --configfile <the benchmark's> {folder / 'best.yaml'}\n```",
    ]


def _markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(Table.of_texts(head, rows).markdown()) if rows else "None."


def _shown(value: Any) -> str:
    """A setting's value as YAML has it, floats short."""
    return f"{value:.4g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
