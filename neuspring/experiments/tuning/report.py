"""The report of a sweep: trials.csv, the best trial as an overlay, and a summary, which is written last.

Everything is made from the sweep's storage, of a sweep that is finished or not. A trial that continues another has its number.
`optuna-dashboard` draws pictures of the storage.
"""

from __future__ import annotations

import functools
import json
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
import yaml
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from neuspring import config
from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.experiments.benchmark import read_methods, read_searches
from neuspring.experiments.tuning.space import CLUSTERS, Plan, labels
from neuspring.experiments.tuning.worker import DEFINITION, FACTS, REASON, VALUES, WORKER, counted, origin, study_of

TABLES_OF_ROWS = {"method": "methods.yaml", "search": "searches.yaml"}
SHARED = ("simulation", "losses", "released_quirks")
"""Sections that belong to no row: an overlay sets them for all methods."""
SHOWN = 10
"""Trials in the summary's table."""
TABLES = ("trials.csv", "best.yaml", *TABLES_OF_ROWS.values())


@dataclass(frozen=True)
class Findings:
    """A sweep as it is read."""

    plan: Plan
    trials: tuple[FrozenTrial, ...]
    """Those that count."""
    table: pd.DataFrame
    """A row per trial."""
    importances: dict[str, float]
    """Setting -> importance, largest first; empty where too few trials finished."""
    scenes: tuple[str, ...]

    @property
    def best(self) -> FrozenTrial | None:
        """The finished trial of least loss; of several, the first."""
        return min((t for t in self.trials if t.state == TrialState.COMPLETE), key=lambda t: (t.value, origin(t)), default=None)

    @property
    def baseline(self) -> float | None:
        """Loss of the unchanged configuration, if trial 0 has finished."""
        return next((trial.value for trial in self.trials if origin(trial) == 0), None)


def state(trial: FrozenTrial) -> str:
    """complete, pruned, failed or running."""
    return "failed" if trial.state == TrialState.FAIL else trial.state.name.lower()


def report(settings: Config, tune: Tune, output: Path, root: Path = Path()) -> None:
    """Sum up a sweep, finished or not. It lies in `output`'s folder. Raises InputError if there is none."""
    plan, folder = Plan.of(settings, tune, root), output.parent
    study = study_of(folder, tune, plan.facts())
    # Trials beyond a `tune.trials` that was lowered count as well.
    begun = tuple(counted(study))
    findings = Findings(plan, begun, _table(begun, plan), _importances(study), tuple(study.user_attrs[DEFINITION]["frames"]))
    # No file of an earlier report may stay beside this one's.
    for name in TABLES:
        (folder / name).unlink(missing_ok=True)
    write_text(folder / "trials.csv", findings.table.to_csv(index=False))
    write_best(findings, settings, folder, root)
    write_text(output, summary(findings, folder))


def _table(begun: Sequence[FrozenTrial], plan: Plan) -> pd.DataFrame:
    rows = []
    for trial in begun:
        facts = trial.user_attrs.get(FACTS, {})
        last = trial.intermediate_values[trial.last_step] if trial.last_step is not None else None
        loss = trial.value if trial.state == TrialState.COMPLETE else None
        row: dict[str, Any] = {"trial": origin(trial), "state": state(trial), "loss": loss, "last_loss": last}
        row |= {"reason": trial.user_attrs.get(REASON, "")}
        row |= dict.fromkeys(plan.tune.space) | labels(trial.user_attrs.get(VALUES, {}))
        row |= {f"loss/{name}": value for name, value in facts.get("losses", {}).items()}
        row |= {f"seconds/{name}": round(value, 3) for name, value in facts.get("seconds", {}).items()}
        row |= {"optuna_trial": trial.number, "worker": trial.user_attrs.get(WORKER)}
        rows.append(row | {name: facts.get(name) for name in ("device", "started", "ended", "commit", "code")})
    # As objects: null is a value, not a missing number.
    table = pd.DataFrame(rows, dtype=object)
    return table.astype({"trial": int, "loss": float, "last_loss": float})


def _importances(study: Study) -> dict[str, float]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            importances = optuna.importance.get_param_importances(study)
        except (ValueError, RuntimeError):  # too few finished trials, or all of the same loss
            return {}
    return {name: float(value) for name, value in importances.items()} if any(importances.values()) else {}


def write_best(findings: Findings, settings: Config, folder: Path, root: Path) -> None:
    """Write best.yaml, an overlay with a new method row, and the tables that it names; nothing if no trial has finished.

    The new method row is the varied one with the best trial's `fit` settings. Its `search` settings and `clusters` make a new
    search row. Settings that belong to no row (simulation, losses, quirks) are set for all methods.
    """
    if findings.best is None:
        return
    plan, values = findings.plan, dict(findings.best.user_attrs[VALUES])
    name, method = tuned_name(plan.tune), plan.tune.method
    description = f"{method}, tuned: trial {origin(findings.best)} of sweep {plan.tune.study}"
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
    overlay |= {f"{table}_table": str((folder / file).resolve()) for table, file in TABLES_OF_ROWS.items()}
    overlay |= {section: sections[section] for section in SHARED if section in sections}
    for file, content in {"best.yaml": overlay, "methods.yaml": methods | {name: tuned}, "searches.yaml": searches}.items():
        write_text(folder / file, yaml.safe_dump(content, sort_keys=False, width=120))


def tuned_name(tune: Tune) -> str:
    """The method row of a sweep's best trial."""
    return f"{tune.method}_{tune.study}"


def summary(findings: Findings, folder: Path) -> str:
    """The sweep in Markdown."""
    plan, tune = findings.plan, findings.plan.tune
    counts = Counter(map(state, findings.trials))
    ended = counts["complete"] + counts["pruned"] + counts["failed"]
    share, many = plan.base["fit"]["tail_fraction"], f"{len(findings.scenes)} scenario{'s' * (len(findings.scenes) > 1)}"
    lines = [
        f"# Sweep {tune.study}: {tune.method} tuned",
        "",
        f"{ended} of {tune.trials} trials: {counts['complete']} finished, {counts['pruned']} pruned, {counts['failed']} failed.",
    ]
    if counts["running"]:
        lines += [f"{counts['running']} more are running, or were left behind by a killed worker."]
    lines += [
        "",
        f"The loss, m², is that of the last {share:.0%} of the training frames, which neither search nor fit has seen.",
        f"It is the mean over {many}: {', '.join(findings.scenes)}. Test frames were not read.",
        "",
    ]
    if (codes := findings.table["code"].nunique()) > 1:
        lines += [f"Trials were made by {codes} versions of the code (see trials.csv) and may not be comparable.", ""]
    lines += _best_lines(findings, folder)
    lines += ["## Importance", ""]
    if findings.importances:
        lines += Table.of_texts(
            ["Setting", "Importance"], [[name, f"{value:.2f}"] for name, value in findings.importances.items()]
        ).markdown()
        lines += ["", "PED-ANOVA over finished trials. With few trials it says little.", ""]
    else:
        lines += ["Not computable: too few trials have finished, or they do not differ.", ""]
    done = findings.table[findings.table["state"] == "complete"].sort_values(["loss", "trial"]).head(SHOWN)
    rows = [
        [str(row["trial"]), f"{row['loss']:.4e}", *(_shown(row[name]) for name in tune.space)] for row in done.to_dict("records")
    ]
    table = Table.of_texts(["Trial", "Loss [m²]", *tune.space], rows).markdown() if rows else ["None."]
    lines += [f"## The best {SHOWN} finished trials", "", *table, "", "All trials: `trials.csv`.", ""]
    if failed := [f"- trial {origin(t)}: {t.user_attrs[REASON]}" for t in findings.trials if t.state == TrialState.FAIL]:
        lines += ["## Failed", "", *failed, ""]
    return "\n".join(lines)


def _best_lines(findings: Findings, folder: Path) -> list[str]:
    plan, best, baseline = findings.plan, findings.best, findings.baseline
    if best is None:
        return ["No trial has finished, so there is no best one.", ""]
    loss = best.value
    assert loss is not None
    if baseline is None:
        compared = "The unchanged configuration (trial 0) has not finished."
    elif origin(best) == 0:
        compared = "That is the unchanged configuration: no trial was better."
    else:
        compared = f"The unchanged configuration (trial 0): {baseline:.4e} m²; a ratio of {loss / baseline:.3f}."
    values, unchanged = labels(best.user_attrs[VALUES]), labels(plan.baseline)
    lines = [
        "## Best",
        "",
        f"Trial {origin(best)}: {loss:.4e} m².",
        compared,
        "The smallest of many losses on the same few frames is optimistic: compare the two methods on test frames.",
        "",
        *Table.of_texts(
            ["Setting", "Best", "Unchanged"], [[name, _shown(values[name]), _shown(unchanged[name])] for name in values]
        ).markdown(),
        "",
        f"`{folder / 'best.yaml'}` is an overlay with both as rows, `{plan.tune.method}` and `{tuned_name(plan.tune)}`:",
        "",
        "```",
        f"snakemake ... --configfile <the benchmark's> {folder / 'best.yaml'}",
        "```",
        "",
    ]
    if shared := [name for name in values if name.split(".")[0] in SHARED]:
        lines += [f"It sets {', '.join(shared)} for both rows: these settings belong to no method.", ""]
    return lines


def _shown(value: Any) -> str:
    """A setting's value as YAML has it, floats short."""
    return f"{value:.4g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
