"""The report of a sweep: trials.csv, run records, the best trial as an overlay, pictures, and a summary, which is written last.

Everything is made from the sweep's storage, of a sweep that is finished or not. Run records of trials and sweep go to MLflow as
those of any run do (`neuspring sync`). Trials have the numbers of their slots. In Optuna's pictures they have its own, which differ
where a trial was begun again.
"""

from __future__ import annotations

import functools
import hashlib
import json
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import yaml
from optuna.study import Study

from neuspring import config
from neuspring.config import Config
from neuspring.config.tuning import Tune
from neuspring.core.files import write_atomically, write_table, write_text
from neuspring.core.records import canonical
from neuspring.core.run_record import RUN_RECORD, RunRecord, key_of
from neuspring.core.table import Table
from neuspring.experiments.benchmark import read_methods, read_searches
from neuspring.experiments.tuning.space import CLUSTERS, Plan, labels
from neuspring.experiments.tuning.worker import DEFINITION, WORKER, Slot, slots, study_of
from neuspring.report.draw.sheet import DPI

TABLES_OF_ROWS = {"method": "methods.yaml", "search": "searches.yaml"}
SHARED = ("simulation", "losses", "released_quirks")
"""Sections that belong to no row: an overlay sets them for all methods."""
SHOWN = 10
"""Trials in the summary's table."""
TABLES = ("trials.csv", "best.yaml", *TABLES_OF_ROWS.values())
PICTURES = {
    "history.png": "Loss of every trial",
    "slices.png": "Loss against each setting",
    "parallel.png": "Settings of the finished trials",
    "importances.png": "Importance of the settings",
    "steps.png": "What pruning saw",
}
LOSS = "loss of the tail [m²]"
LOG_FROM = 3.0
"""A loss has a log axis if its largest value is at least this many times its smallest."""
LEGEND = 16
"""The most entries of a legend that is shown."""
WIDTH, HEIGHT = 2.9, 3.8
"""Size of a panel, inches."""
KEYED = ("scenario", "source", "category", "method", "variant", "seed", "status", "reason", "data_digest", "params")
"""Fields that the key of a run record is made of, beside its scores and results."""


@dataclass(frozen=True)
class Findings:
    """A sweep as it is read."""

    plan: Plan
    slots: tuple[Slot, ...]
    table: pd.DataFrame
    """A row per slot that has a trial."""
    importances: dict[str, float]
    """Setting -> importance, largest first; empty where too few trials finished."""
    scenes: tuple[str, ...]

    @property
    def best(self) -> Slot | None:
        """The finished trial of least loss; of several, the first."""
        done = [slot for slot in self.slots if slot.state == "complete"]
        return min(done, key=lambda slot: (slot.loss, slot.number), default=None)

    @property
    def baseline(self) -> float | None:
        """Loss of the unchanged configuration, if trial 0 has finished."""
        return next((slot.loss for slot in self.slots if slot.number == 0), None)


def report(settings: Config, tune: Tune, output: Path, root: Path = Path()) -> None:
    """Sum up a sweep, finished or not. It lies in `output`'s folder. Raises InputError if there is none."""
    plan, folder = Plan.of(settings, tune, root), output.parent
    study = study_of(folder, tune, plan.facts())
    definition = study.user_attrs[DEFINITION]
    # Trials beyond a `tune.trials` that was lowered count as well.
    begun = tuple(slots(study).values())
    findings = Findings(plan, begun, _table(begun, plan), _importances(study), tuple(definition["frames"]))
    for slot in begun:
        if slot.state in ("complete", "pruned", "failed"):
            _record_trial(findings, slot, definition, folder)
    # No file of an earlier report may stay beside this one's.
    for name in (*TABLES, *PICTURES):
        (folder / name).unlink(missing_ok=True)
    write_text(folder / "trials.csv", findings.table.to_csv(index=False))
    write_best(findings, settings, folder, root)
    if findings.table["state"].isin(["complete", "pruned"]).any():
        _draw(study, folder, importances=bool(findings.importances))
    write_text(output, summary(findings, folder))
    files = [output, *(folder / name for name in (*TABLES, *PICTURES) if (folder / name).is_file())]
    _record_sweep(findings, definition, files, folder)


def _table(begun: Sequence[Slot], plan: Plan) -> pd.DataFrame:
    rows = []
    for slot in begun:
        trial, facts = slot.last, slot.facts
        last = trial.intermediate_values[trial.last_step] if trial.last_step is not None else None
        row: dict[str, Any] = {"trial": slot.number, "state": slot.state}
        row |= {"loss": slot.loss, "last_loss": last, "reason": slot.reason}
        row |= dict.fromkeys(plan.tune.space) | labels(slot.values)
        row |= {f"loss/{name}": value for name, value in facts.get("losses", {}).items()}
        row |= {f"seconds/{name}": round(value, 3) for name, value in facts.get("seconds", {}).items()}
        row |= {"attempts": len(slot.trials), "optuna_trial": trial.number, "worker": trial.user_attrs.get(WORKER)}
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
    plan, values = findings.plan, dict(findings.best.values)
    name, method = tuned_name(plan.tune), plan.tune.method
    description = f"{method}, tuned: trial {findings.best.number} of sweep {plan.tune.study}"
    clusters = values.pop(CLUSTERS, None)
    sections: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        *above, key = path.split(".")
        functools.reduce(lambda inside, part: inside.setdefault(part, {}), above, sections)[key] = value
    methods = {key: config.plain(row) for key, row in read_methods(root / settings.method_table).items()}
    searches = {key: config.plain(row) for key, row in read_searches(root / settings.search_table).items()}
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
    counts = Counter(slot.state for slot in findings.slots)
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
    if failed := [f"- trial {slot.number}: {slot.reason}" for slot in findings.slots if slot.state == "failed"]:
        lines += ["## Failed", "", *failed, ""]
    lines += [line for name, text in PICTURES.items() if (folder / name).is_file() for line in (f"![{text}]({name})", "")]
    return "\n".join(lines)


def _best_lines(findings: Findings, folder: Path) -> list[str]:
    plan, best, baseline = findings.plan, findings.best, findings.baseline
    if best is None:
        return ["No trial has finished, so there is no best one.", ""]
    loss = best.loss
    assert loss is not None
    if baseline is None:
        compared = "The unchanged configuration (trial 0) has not finished."
    elif best.number == 0:
        compared = "That is the unchanged configuration: no trial was better."
    else:
        compared = f"The unchanged configuration (trial 0): {baseline:.4e} m²; a ratio of {loss / baseline:.3f}."
    values, unchanged = labels(best.values), labels(plan.baseline)
    lines = [
        "## Best",
        "",
        f"Trial {best.number}: {loss:.4e} m².",
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


def _draw(study: Study, folder: Path, *, importances: bool) -> None:
    """Draw a sweep that has a finished or pruned trial; `importances`: whether they can be computed."""
    import optuna.visualization.matplotlib as plots
    from matplotlib import pyplot as plt

    def save(name: str, columns: float, plot: Callable[[], Any], losses: Sequence[float] = (), **labels: str) -> None:
        """Save a picture of `columns` panels; `losses` are those on its y axis."""
        with warnings.catch_warnings(), plt.style.context("default"):
            warnings.simplefilter("ignore")
            axes = list(np.ravel(plot()))
        figure = axes[0].figure.get_figure(root=True)
        figure.set_size_inches(WIDTH * columns + 0.8, HEIGHT)
        if losses and max(losses) >= LOG_FROM * min(losses) > 0:
            axes[0].set_yscale("log")
        if (legend := axes[0].get_legend()) and len(legend.get_texts()) > LEGEND:
            legend.remove()
        axes[0].set(**labels)
        write_atomically(folder / name, lambda path: figure.savefig(path, dpi=DPI, format="png", bbox_inches="tight"))
        plt.close(figure)

    trials = study.get_trials(deepcopy=False)
    losses = [trial.value for trial in trials if trial.value is not None]
    steps = [value for trial in trials for value in trial.intermediate_values.values()]
    columns = len({name for trial in trials for name in trial.params})
    if losses:
        save("history.png", 2.4, lambda: plots.plot_optimization_history(study, target_name=LOSS), losses)
        save("slices.png", columns, lambda: plots.plot_slice(study, target_name=LOSS), losses)
        save("parallel.png", columns, lambda: plots.plot_parallel_coordinate(study, target_name=LOSS))
    if importances:
        save("importances.png", 2.4, lambda: plots.plot_param_importances(study, target_name=LOSS))
    if steps:
        told = {"xlabel": "epoch, counted through the scenarios", "ylabel": f"mean {LOSS}", "title": ""}
        save("steps.png", 3.0, lambda: plots.plot_intermediate_values(study), steps, **told)


def _record_trial(findings: Findings, slot: Slot, definition: Mapping[str, Any], folder: Path) -> None:
    """Write trials/<slot>/run.json and the files that it names, unless they are there."""
    plan, trial = findings.plan, slot.last
    times = {"started": _utc(trial.datetime_start), "ended": _utc(trial.datetime_complete or trial.datetime_start)}
    facts = times | {"seconds": {}} | slot.facts
    scores = {"loss": slot.loss} if slot.state == "complete" else {}
    scores |= {f"loss/{name}": value for name, value in facts.get("losses", {}).items()}
    _write_record(
        plan.tune,
        definition,
        folder / "trials" / str(slot.number),
        facts,
        scores,
        sorted(trial.intermediate_values.items()),
        scenario=f"trial-{slot.number}",
        variant={"study": plan.tune.study, "method": plan.tune.method, "state": slot.state, **labels(slot.values)},
        status="failed" if slot.state == "failed" else "ok",
        reason=slot.reason,
        params=labels(plan.flat(slot.values)),
        attempt=len(slot.trials),
        histories={"steps": "history.parquet"},
    )


def _record_sweep(findings: Findings, definition: Mapping[str, Any], files: Sequence[Path], folder: Path) -> None:
    """Write the run.json of the sweep. `files`, its tables and pictures, lie in `folder`."""
    tune, best = findings.plan.tune, findings.best
    made = [slot.facts for slot in findings.slots if slot.facts] or [{"started": _utc(None), "ended": _utc(None), "seconds": {}}]
    facts = made[-1] | {"started": min(fact["started"] for fact in made), "ended": max(fact["ended"] for fact in made)}
    facts |= {"seconds": {name: sum(fact["seconds"].get(name, 0.0) for fact in made) for name in ("search", "fit")}}
    scores = {"best": best.loss if best else None, "baseline": findings.baseline}
    _write_record(
        tune,
        definition,
        folder,
        facts,
        {name: value for name, value in scores.items() if value is not None},
        [[slot.number, slot.state, slot.last.value] for slot in findings.slots],
        scenario="study",
        variant={"study": tune.study, "method": tune.method, "pruner": tune.pruner},
        status="ok" if best else "failed",
        reason="" if best else "no trial has finished",
        params={"trials": tune.trials, "workers": tune.workers, "startup_trials": tune.startup_trials},
        attempt=1,
        artifacts={
            "tables": [path.name for path in files if path.suffix != ".png"],
            "plots": [path.name for path in files if path.suffix == ".png"],
        },
    )


def _write_record(
    tune: Tune,
    definition: Mapping[str, Any],
    folder: Path,
    facts: Mapping[str, Any],
    scores: Mapping[str, Any],
    results: Sequence[Any],
    **fields: Any,
) -> None:
    """Write a run record under its key, with its scores and history, unless a record of that key is there."""
    record = RunRecord(
        run_key="0" * 8,  # until the record is complete
        source="tune",
        category="tune",
        method=f"tune-{tune.study}",
        seed=tune.seed,
        data_digest=hashlib.sha256(canonical(definition.get("frames", {})).encode()).hexdigest(),
        commit=facts.get("commit", ""),
        device=facts.get("device", ""),
        started=facts["started"],
        ended=facts["ended"],
        timings=facts["seconds"],
        scores_file="scores.parquet",
        **fields,
    )
    path = folder / RUN_RECORD
    # Without timings: the same results have the same key.
    key = key_of({name: getattr(record, name) for name in KEYED}, scores, results)
    if path.is_file() and RunRecord.load(path).run_key == key:
        return
    tables = {"scores.parquet": [("task", "metric", "value"), *(("tail", *score) for score in scores.items())]}
    if record.histories:
        tables["history.parquet"] = [("step", "metric", "value"), *((step, "tail_loss", value) for step, value in results)]
    for name, (header, *rows) in tables.items():
        write_table(pd.DataFrame(rows, columns=list(header)).astype({"value": "float64"}), folder / name)
    replace(record, run_key=key).save(path)


def _utc(time: datetime | None) -> str:
    """A time of Optuna's, which is local and names no zone, in UTC, ISO 8601; now if there is none."""
    return (time or datetime.now()).astimezone(UTC).isoformat(timespec="seconds")
