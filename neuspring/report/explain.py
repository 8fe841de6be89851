"""Where a cell of a study's table comes from: every run behind it, its settings, code and data, and how to make it again.

Everything is read from the records on disk, none of it from MLflow: the value is computed anew and compared with the table's, and
all files that the runs' records name are checked against their digests.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring import config
from neuspring.core.artifacts import SAFE_NAME
from neuspring.core.errors import InputError
from neuspring.core.records import RECORD_FORMAT, StageRecord, canonical, digest_file, read_json
from neuspring.core.run_record import RESULT_ROLES
from neuspring.report.tables.cells import accounted, cells, counted, of_study
from neuspring.report.tables.study import Made
from neuspring.report.tables.summary import Collected, collect
from neuspring.scores import paper
from neuspring.scores.paper import MEASURES

CONTENT = ("scenario", "method", "variant", "seed", "status", "reason", "notes", "settings", "data_digest")
"""What the key of a run is taken of, beside its files; see `stages.score`."""
FACTS = ("run_key", "source", "commit", "device", "machine", "started", "ended", "data_digest")
PICTURE_STAGES = ("appearance", "render")
"""Their settings are those of `images` and of perception's lifting."""
UNREADABLE = (InputError, OSError, KeyError, TypeError, AttributeError, ValueError)


@dataclass(frozen=True, kw_only=True)
class Behind:
    """A run behind a cell, counted or left out."""

    scenario: str
    seed: int
    status: str
    why: str = ""
    """Why it is left out; empty for a run that counts."""
    value: float | None = None
    """In the paper's unit."""
    frames: int | None = None
    record: str = ""
    """Path of run.json; empty if there is none."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """`FACTS` of the record."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What differs from the defaults, under the names that MLflow has too; the seed is left out."""
    files: int = 0
    """Files that were compared with their digests."""
    problems: Sequence[str] = ()
    """What is no longer as recorded."""
    command: str = ""
    """Makes the run again."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A cell of a study's table and what it is made of."""

    cell: str
    """study/label/task/metric."""
    row: Mapping[str, Any]
    """The cell as in the table's CSV, from the records as they are now."""
    in_table: float | None
    """What the table says."""
    runs: Sequence[Behind]
    left_out: Sequence[Behind]
    not_applying: Sequence[str] = ()
    """Scenarios to which the method does not apply, so that it has no runs there."""

    @property
    def problems(self) -> list[str]:
        """What does not hold: a table that is older than its runs, files that are not as recorded."""
        ours = self.row["ours"]
        stale = [] if ours == self.in_table else [f"the table says {self.in_table}, its runs now say {ours}: make it again"]
        return stale + [f"{run.scenario} / seed {run.seed}: {text}" for run in self.runs for text in run.problems]

    def as_json(self) -> str:
        """Everything, as JSON text."""
        return json.dumps(asdict(self) | {"problems": self.problems}, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def explain(cell: str, results: Path, folder: Path, configfiles: Sequence[str] = ()) -> Explanation:
    """Explain `cell`, named STUDY/ROW/TASK/METRIC, of the tables in `folder`.

    ROW is a label or a method; labels, tasks and metrics may be shortened where that is clear, and the paper's names will do.
    `configfiles` are those that the runs were made with, for the commands. Raises InputError for a cell that there is not, with
    those that there are.
    """
    made, table = _find_table(cell, folder)
    label, task, metric = _find_cell(cell, made, table)
    found = of_study(made.study, collect(results, made.scenarios, made.methods, made.seeds, made.left_out))
    wanted = (found.scores["task"] == task) & (found.scores["metric"] == metric)
    own = Collected(found.scores[wanted], found.runs, left_out=found.left_out)
    rows = _records(_only(cells(made.study, own), label, task, metric))
    if not rows:
        remedy = f"Make the table again: snakemake {made.name}."
        raise InputError(f"cell {cell!r}", f"the runs that {made.name}.csv was made of must be in {results}", "none", remedy)
    method = rows[0]["method"]
    values, scores = (
        {(run["scenario"], run["seed"]): run for run in _records(part[part["method"] == method])}
        for part in (own.scores, counted(own))
    )
    runs: list[Behind] = []
    left: list[Behind] = []
    for run in _records(accounted(made.study, own)):
        if run["method"] == method:
            key = (run["scenario"], run["seed"])
            why = run["why"] or ("" if key in scores else _without_value(key in values))
            (left if why else runs).append(_behind(run, why, values.get(key), Path(results), configfiles))
    before = _only(table, label, task, metric)["ours"]
    return Explanation(
        cell=f"{made.name}/{label}/{task}/{metric}",
        row={name: None if isinstance(value, float) and math.isnan(value) else value for name, value in rows[0].items()},
        in_table=None if before.isna().all() else float(before.iloc[0]),
        runs=runs,
        left_out=left,
        not_applying=tuple(found.left_out.get(method, ())),
    )


def _without_value(has_one: bool) -> str:
    return "another method has no value of this metric here" if has_one else "no value of this metric (see the notes of its run)"


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


def _only(table: pd.DataFrame, label: str, task: str, metric: str) -> pd.DataFrame:
    return table[(table["label"] == label) & (table["task"] == task) & (table["metric"] == metric)]


def _find_table(cell: str, folder: Path) -> tuple[Made, pd.DataFrame]:
    """The study that a cell names: what its table was made of, and its CSV."""
    names = sorted(path.stem for path in Path(folder).glob("*.json") if path.with_suffix(".csv").is_file())
    if not names:
        raise InputError(
            folder, "the tables of studies must be here", "none", "Make one first: snakemake table1 (or another study)."
        )
    study = _choose(cell.partition("/")[0], {name: name for name in names}, "study", cell)
    assert SAFE_NAME.fullmatch(study)
    # Text stays text: a label may be a number, and the paper's digits count.
    text = dict.fromkeys(("label", "paper", "baseline", "unit"), str)
    table = pd.read_csv(
        Path(folder) / f"{study}.csv", dtype=text, keep_default_na=False, na_values=[""], float_precision="round_trip"
    )
    return Made.load(Path(folder) / f"{study}.json"), table


def _find_cell(cell: str, made: Made, table: pd.DataFrame) -> tuple[str, str, str]:
    """Label, task and metric of a cell. Labels may hold a slash."""
    known = [f"{made.name}/{row.label}/{row.task}/{row.metric}" for row in table.itertuples()]
    parts = cell.split("/")
    if len(parts) < 4:
        raise InputError(f"cell {cell!r}", "a cell is STUDY/ROW/TASK/METRIC", None, _suggestions(cell, known))
    labels = {label: label for label in made.study.rows}
    labels |= {method: label for label, method in made.study.rows.items() if method not in labels}
    label = _choose("/".join(parts[1:-2]), labels, "row", cell)
    tasks = {task: task for task in table["task"].unique()} | {theirs: ours for ours, theirs in paper.TASKS.items()}
    metrics = {
        name: metric
        for metric in table["metric"].unique()
        for name in (MEASURES[metric].heading.lower(), MEASURES[metric].paper, metric)
    }
    return label, _choose(parts[-2], tasks, "task", cell), _choose(parts[-1], metrics, "metric", cell)


def _choose(word: str, options: Mapping[str, str], what: str, cell: str) -> str:
    """The option that `word` names: in full, in another case, or as the beginning of one alone. Raises InputError."""
    lower = word.lower()
    matches = [{options[word]}] if word in options else []
    matches += [{value for name, value in options.items() if name.lower() == lower}]
    matches += [{value for name, value in options.items() if name.lower().startswith(lower)}] if word else []
    found = next((values for values in matches if values), set())
    if len(found) != 1:
        rule = f"must name one {what}" + (f"; it could be {', '.join(sorted(found))}" if found else "")
        raise InputError(f"cell {cell!r}", rule, repr(word), _suggestions(word, options))
    return found.pop()


def _suggestions(word: str, options: Iterable[str]) -> str:
    options = list(options)
    close = difflib.get_close_matches(word, options, n=3, cutoff=0.5)
    return (f"Did you mean {' or '.join(close)}? " if close else "") + f"Known: {', '.join(options)}."


def _behind(run: Mapping[str, Any], why: str, score: Mapping[str, Any] | None, results: Path, configfiles: Sequence[str]) -> Behind:
    """All that the records say of a run."""
    scenario, method, seed = run["scenario"], run["method"], run["seed"]
    path = results / scenario / method / str(seed) / "run.json"
    identity: dict[str, Any] = {"scenario": scenario, "seed": seed, "status": run["status"], "why": why}
    identity |= {"value": score["value"], "frames": score["frames"]} if score else {}
    if not path.is_file():
        return Behind(**identity, command=rerun(results, scenario, method, seed, {}, configfiles))
    try:
        record = read_json(path, RECORD_FORMAT)
        files, problems = check_files(path, record, results / scenario / "observations.npz")
        return Behind(
            **identity,
            record=str(path),
            facts={name: record[name] for name in FACTS},
            settings=departures(record["settings"]),
            files=files,
            problems=problems,
            command=rerun(results, scenario, method, seed, record, configfiles),
        )
    except UNREADABLE as error:
        problem = f"{path}: damaged: {' '.join(str(error).split()) or type(error).__name__}"
        return Behind(**identity, record=str(path), problems=[problem])


def check_files(path: Path, record: Mapping[str, Any], observations: Path) -> tuple[int, list[str]]:
    """How many files of a run were compared with their digests, and what is no longer as recorded.

    The run's key is taken anew of its content, its scores and the results of its stages, so that a change of any shows.
    """
    stages: dict[str, StageRecord] = {}
    problems, files = [], 0
    for name in record["artifacts"]["records"]:
        place = path.parent / name
        try:
            stage = StageRecord.load(place)
        except InputError as error:
            problems.append(str(error))
            continue
        stages[stage.stage] = stage
        for role in stage.files:
            files += 1
            try:
                stage.file(role, place)
            except InputError as error:
                problems.append(str(error))
    made = {name: stage.files[role][1] for name, stage in stages.items() for role in RESULT_ROLES if role in stage.files}
    scores = path.parent / record["scores_file"]
    made["scores"] = digest_file(scores) if scores.is_file() else ""
    key = hashlib.sha256(canonical([{name: record[name] for name in CONTENT}, made]).encode()).hexdigest()
    if key != record["run_key"]:
        problems.append(f"{path}: its run_key is not that of its content, its scores and the results of its stages")
    if observations.is_file() and digest_file(observations) != record["data_digest"]:
        problems.append(f"{observations}: other content than the run was scored on")
    return files + 1 + observations.is_file(), problems


def departures(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Stage -> settings, as flat names of those that differ from the defaults; what has no default is always named."""
    defaults = config.plain(config.Config())
    pictures = defaults["images"] | {"lift": defaults["perception"]["lift"]}
    models = {None: defaults, **defaults["baselines"]}
    found: dict[str, Any] = {}
    for stage, values in settings.items():
        # What trains a baseline's model has the settings of its section side by side.
        of_model = models.get(values.get("model"), defaults)
        _compare(values, pictures if stage in PICTURE_STAGES else of_model, stage, found)
    return {name: value for name, value in sorted(found.items()) if not name.endswith(".seed")}


def _compare(values: Mapping[str, Any], defaults: Mapping[str, Any], prefix: str, found: dict[str, Any]) -> None:
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            _compare(value, default, f"{prefix}.{name}", found)
        elif name not in defaults or value != default:
            found[f"{prefix}.{name}"] = value


def rerun(results: Path, scenario: str, method: str, seed: int, record: Mapping[str, Any], configfiles: Sequence[str] = ()) -> str:
    """The command that makes a run again, every stage of it; from the records that there are where it has not run."""
    target = f"{results}/{scenario}/{method}/{seed}/run.json"
    words = ["snakemake", target, "--profile", "workflow/profiles/default", "--cores", "1"]
    words += ["--configfile", *configfiles] if configfiles else []
    words += ["--config", f"results={results}", f"only=scenario={scenario} method={method} seed={seed}"]
    if record:
        # A baseline's model has a rule of its own for its rollout.
        model = record["variant"].get("model")
        rules = ["predict" if model and stage == "rollout" else stage for stage in record["settings"]]
        words += [f"device={str(record['device']).partition(':')[0]}", "--forcerun", *rules, "score"]
    return shlex.join(words)
