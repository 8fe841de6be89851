"""Where a number comes from, of a study's table or of the benchmark's: every run behind it, its settings, code and data, and how to
make it again. The same of single runs.

Everything is read from the records on disk, nothing from MLflow. The value is computed again and compared with the table's. All
files that the records of the runs name are compared with their digests. `text` is the explanation for people.
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
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.core.artifacts import SAFE_NAME
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord, canonical, digest_file
from neuspring.core.run_folder import RESULTS
from neuspring.core.run_record import RUN_RECORD, RunRecord, key_of
from neuspring.core.table import Table
from neuspring.report.study import StudyRecord, our_change, paper_change
from neuspring.report.study_cells import accounted, cells, counted, restricted
from neuspring.scores import paper
from neuspring.scores.failures import left_out_lines
from neuspring.scores.metrics import DASH, IN_STUDIES, METRICS, Metric
from neuspring.scores.runs import Collected, collect, one_line

FACTS = ("run_key", "source", "commit", "device", "machine", "started", "ended", "data_digest")
ROUND_OFF = 1e-12
BENCHMARK = "summary"
"""Stands for a study where a cell of the benchmark's own table is meant."""
PICTURE_STAGES = ("appearance", "render")
"""Their settings are those of `images` and of perception's lifting."""


@dataclass(frozen=True, kw_only=True)
class Behind:
    """A run behind a cell, counted or left out."""

    scenario: str
    seed: int
    status: str
    why: str = ""
    """Why it is left out; empty for a run that counts."""
    value: float | None = None
    """In mm, or the unit of the metric."""
    frames: int | None = None
    record: str = ""
    """Path of run.json; empty if there is none."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """`FACTS` of the record."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that differ from the defaults, under the names that MLflow shows; without the seed."""
    files: int = 0
    """Files that were compared with their digests."""
    problems: Sequence[str] = ()
    """Files that are no longer as recorded."""
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
    """The value in the table."""
    runs: Sequence[Behind]
    left_out: Sequence[Behind]
    not_applying: Sequence[str] = ()
    """Scenarios to which the method does not apply, so that it has no runs there."""

    @property
    def problems(self) -> list[str]:
        """A table that is older than its runs, and files that are not as recorded."""
        ours = self.row["ours"]
        same = ours == self.in_table or (
            None not in (ours, self.in_table) and math.isclose(ours, self.in_table or 0, rel_tol=ROUND_OFF)
        )
        stale = [] if same else [f"the table says {self.in_table}, its runs now say {ours}: make it again"]
        return stale + [f"{run.scenario} / seed {run.seed}: {text}" for run in self.runs for text in run.problems]

    def as_json(self) -> str:
        """Everything, as JSON text."""
        return json.dumps(asdict(self) | {"problems": self.problems}, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def explain(cell: str, results: Path, folder: Path, configfiles: Sequence[str] = ()) -> Explanation:
    """Explain `cell`, named STUDY/ROW/TASK/METRIC, of the tables in `folder`, or METHOD/TASK/METRIC of the benchmark's beside it.

    ROW is a label or a method. Labels, tasks and metrics may be shortened where only one fits; the paper's names work too.
    `configfiles` are those that the runs were made with; the commands name them. Raises InputError for an unknown cell, and lists
    the known ones.
    """
    cell = f"{BENCHMARK}/{cell}" if cell.count("/") == 2 else cell
    files, table = _find_table(cell, folder)
    label, task, metric = _find_cell(cell, files, table)
    study = restricted(files.study, collect(results, files.scenarios, files.methods, files.seeds, files.left_out))
    wanted = (study.scores["task"] == task) & (study.scores["metric"] == metric)
    own = Collected(study.scores[wanted], study.runs, left_out=study.left_out)
    rows = _records(_only(cells(files.study, own), label, task, metric))
    if not rows:
        remedy = f"Make the table again: snakemake {files.name}."
        raise InputError(f"cell {cell!r}", f"the runs that {files.name}.csv was made of must be in {results}", "none", remedy)
    method = rows[0]["method"]
    values, scores = (
        {(run["scenario"], run["seed"]): run for run in _records(part[part["method"] == method])}
        for part in (own.scores, counted(own))
    )
    runs: list[Behind] = []
    left: list[Behind] = []
    for run in _records(accounted(files.study, own)):
        if run["method"] == method:
            key = (run["scenario"], run["seed"])
            why = run["why"] or ("" if key in scores else _without_value(key in values))
            (left if why else runs).append(_behind(run, why, values.get(key), Path(results), configfiles))
    before = _only(table, label, task, metric)["ours"]
    return Explanation(
        cell=f"{files.name}/{label}/{task}/{metric}",
        row={name: None if isinstance(value, float) and math.isnan(value) else value for name, value in rows[0].items()},
        in_table=None if before.isna().all() else float(before.iloc[0]),
        runs=runs,
        left_out=left,
        not_applying=tuple(own.left_out.get(method, ())),
    )


def _without_value(has_one: bool) -> str:
    return "another method has no value of this metric here" if has_one else "no value of this metric (see the notes of its run)"


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


def _only(table: pd.DataFrame, label: str, task: str, metric: str) -> pd.DataFrame:
    return table[(table["label"] == label) & (table["task"] == task) & (table["metric"] == metric)]


def _find_table(cell: str, folder: Path) -> tuple[StudyRecord, pd.DataFrame]:
    """The study that a cell names: what its table was made of, and its CSV."""
    names = studies_in(folder)
    own = [BENCHMARK] if _has_numbers(Path(folder).parent) else []
    if not names and not own:
        raise InputError(
            folder, "tables must be here", "none", "Make them first: `neuspring tables` (a study: `snakemake table1`, or another)."
        )
    study = _choose(cell.partition("/")[0], {name: name for name in [*own, *names]}, "study", cell)
    if study == BENCHMARK:
        return _benchmark(Path(folder).parent)
    assert SAFE_NAME.fullmatch(study)
    # Text stays text: a label may be a number, and the paper's digits count.
    text = dict.fromkeys(("label", "paper", "baseline", "unit"), str)
    table = pd.read_csv(
        Path(folder) / f"{study}.csv", dtype=text, keep_default_na=False, na_values=[""], float_precision="round_trip"
    )
    return StudyRecord.load(Path(folder) / f"{study}.json"), table


def studies_in(folder: Path) -> list[str]:
    """The studies whose tables are in a folder."""
    return sorted(path.stem for path in Path(folder).glob("*.json") if path.with_suffix(".csv").is_file())


def _has_numbers(folder: Path) -> bool:
    """Whether a folder of tables has averages; where no run can be compared, their file is there and empty."""
    averages = folder / "averages.csv"
    return averages.is_file() and averages.stat().st_size > 1


def _benchmark(folder: Path) -> tuple[StudyRecord, pd.DataFrame]:
    """The benchmark's own table as a study, whose rows are its methods."""
    runs, means = (pd.read_csv(folder / f"{name}.csv", float_precision="round_trip") for name in ("runs", "averages"))
    means = means[means["metric"].isin(list(IN_STUDIES))]
    metrics = [IN_STUDIES[str(name)] for name in means["metric"]]
    ours = [metric.paper_factor * row[metric.average] for metric, row in zip(metrics, _records(means), strict=True)]
    scenarios, methods, seeds = (tuple(dict.fromkeys(runs[name].tolist())) for name in ("scenario", "method", "seed"))
    there = set(zip(runs["method"], runs["scenario"], strict=True))
    study = paper.Study(title="Scores", reference=None, baseline=methods[0], rows={name: name for name in methods})
    left_out = {name: tuple(place for place in scenarios if (name, place) not in there) for name in methods}
    record = StudyRecord(name=BENCHMARK, study=study, scenarios=scenarios, methods=methods, seeds=seeds, left_out=left_out)
    return record, means.assign(label=means["method"], ours=ours)


def runs_of(word: str, results: Path) -> list[Path]:
    """The records of runs that a word names: a folder, SCENARIO, SCENARIO/METHOD/SEED, or METHOD."""
    word = word.removesuffix(f"/{RUN_RECORD}")
    places = [Path(word), Path(results) / word, *(Path(results).glob(f"*/{word}") if SAFE_NAME.fullmatch(word) else ())]
    return sorted({path for place in places for below in ("", "*/", "*/*/") for path in place.glob(f"{below}{RUN_RECORD}")})


def run_text(path: Path, configfiles: Sequence[str] = ()) -> tuple[str, bool]:
    """What is known of a run, and whether all is as recorded."""
    record, results = RunRecord.load(path), path.absolute().parents[3]
    found = _behind(asdict(record), "", None, results, configfiles)
    scores = pd.read_parquet(path.parent / record.scores_file) if record.scores_file else pd.DataFrame()
    lines = [f"{record.name}: {record.status}{': ' * bool(record.reason)}{record.reason}"]
    for task, part in scores.groupby("task", sort=False) if len(scores) else ():
        values = [(METRICS[row["metric"]], row["value"]) for row in _records(part)]
        texts = [f"{metric.heading} {metric.text(value)} {metric.shown_unit}".rstrip() for metric, value in values]
        lines.append(f"  {task}: {', '.join(texts)}")
    lines += [f"  note: {note}" for note in record.notes]
    facts = [f"  {name}: {_commit(str(value)) if name == 'commit' else value}" for name, value in found.facts.items()]
    lines += [*facts, *(f"  {name}: {json.dumps(value)}" for name, value in found.settings.items())]
    lines += [f"  {found.files} files compared with their digests; {len(found.problems) or 'nothing'} not as recorded"]
    return "\n".join([*lines, *(f"  - {problem}" for problem in found.problems), f"  again: {found.command}"]), not found.problems


def known(results: Path, folder: Path) -> str:
    """What can be explained here."""
    runs = [path.parent.relative_to(results).as_posix() for path in sorted(Path(results).glob(f"*/*/*/{RUN_RECORD}"))]
    if not runs:
        raise InputError(results, "a results folder with finished runs is required", "none", "Name another: --results FOLDER.")
    lines = [f"A study: {name}/ROW/TASK/METRIC" for name in studies_in(folder)]
    if _has_numbers(folder.parent):
        _, table = _benchmark(folder.parent)
        names = [" | ".join(dict.fromkeys(table[column])) for column in ("label", "task", "metric")]
        lines.insert(0, f"A number of {folder.parent}/summary.md: METHOD/TASK/METRIC, of\n  " + "\n  ".join(names))
    more = [f"and {len(runs) - MOST} more"] if len(runs) > MOST else []
    return "\n".join([*lines, "A run: " + "\n       ".join([*runs[:MOST], *more])])


def _find_cell(cell: str, files: StudyRecord, table: pd.DataFrame) -> tuple[str, str, str]:
    """Label, task and metric of a cell. Labels may hold a slash."""
    cells = [f"{files.name}/{row.label}/{row.task}/{row.metric}" for row in table.itertuples()]
    parts = cell.split("/")
    if len(parts) < 4:
        rule = "a number is METHOD/TASK/METRIC or STUDY/ROW/TASK/METRIC, a run SCENARIO/METHOD/SEED"
        raise InputError(f"cell {cell!r}", rule, None, _suggestions(cell, cells))
    labels = {label: label for label in files.study.rows}
    labels |= {method: label for label, method in files.study.rows.items() if method not in labels}
    label = _choose("/".join(parts[1:-2]), labels, "row", cell)
    tasks = {task: task for task in table["task"].unique()} | {theirs: ours for ours, theirs in paper.TASKS.items()}
    metrics = {
        name: metric
        for metric in table["metric"].unique()
        for name in (IN_STUDIES[metric].paper_heading.lower(), IN_STUDIES[metric].paper_name or metric, metric)
    }
    return label, _choose(parts[-2], tasks, "task", cell), _choose(parts[-1], metrics, "metric", cell)


def _choose(word: str, options: Mapping[str, str], what: str, cell: str) -> str:
    """The option that `word` names: in full, in another case, or as the beginning of only one. Raises InputError."""
    lower = word.lower()
    matches = [{options[word]}] if word in options else []
    matches += [{value for name, value in options.items() if name.lower() == lower}]
    matches += [{value for name, value in options.items() if name.lower().startswith(lower)}] if word else []
    fitting = next((values for values in matches if values), set())
    if len(fitting) != 1:
        rule = f"must name one {what}" + (f"; it could be {', '.join(sorted(fitting))}" if fitting else "")
        raise InputError(f"cell {cell!r}", rule, repr(word), _suggestions(word, options))
    return fitting.pop()


def _suggestions(word: str, options: Iterable[str]) -> str:
    options = list(options)
    close = difflib.get_close_matches(word, options, n=3, cutoff=0.5)
    return (f"Did you mean {' or '.join(close)}? " if close else "") + f"Known: {', '.join(options)}."


def _behind(run: Mapping[str, Any], why: str, score: Mapping[str, Any] | None, results: Path, configfiles: Sequence[str]) -> Behind:
    """All that the records tell of a run."""
    scenario, method, seed = run["scenario"], run["method"], run["seed"]
    path = results / scenario / method / str(seed) / RUN_RECORD
    identity: dict[str, Any] = {"scenario": scenario, "seed": seed, "status": run["status"], "why": why}
    identity |= {"value": score["value"], "frames": score["frames"]} if score else {}
    if not path.is_file():
        return Behind(**identity, command=rerun(results, scenario, method, seed, None, configfiles))
    try:
        record = RunRecord.load(path)
        files, problems = check_files(path, record, results / scenario / "observations.npz")
        return Behind(
            **identity,
            record=str(path),
            facts={name: getattr(record, name) for name in FACTS},
            settings=departures(record.settings),
            files=files,
            problems=problems,
            command=rerun(results, scenario, method, seed, record, configfiles),
        )
    except (OSError, ValueError) as error:
        return Behind(**identity, record=str(path), problems=[f"{path}: damaged: {one_line(error)}"])


def check_files(path: Path, record: RunRecord, observations: Path) -> tuple[int, list[str]]:
    """How many files of a run were compared with their digests, and which are no longer as recorded.

    The key of the run is computed again from its content, its scores and the results of its stages, so that any change shows.
    """
    stages: dict[str, StageRecord] = {}
    problems, files = [], 0
    for name in record.artifacts.get("records", []):
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
    digests = {name: stage.files[role][1] for name, stage in stages.items() for role in RESULTS if role in stage.files}
    scores = path.parent / (record.scores_file or "")
    digests["scores"] = digest_file(scores) if scores.is_file() else ""
    if key_of(record.content, digests) != record.run_key:
        problems.append(f"{path}: its run_key is not that of its content, its scores and the results of its stages")
    if observations.is_file() and digest_file(observations) != record.data_digest:
        problems.append(f"{observations}: other content than the run was scored on")
    return files + 1 + observations.is_file(), problems


def departures(settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The settings of every stage that differ from the defaults or have no default, under dotted names."""
    defaults = config.plain(config.Config())
    pictures = defaults | defaults["images"] | {"lift": defaults["perception"]["lift"]}
    models = {None: defaults, **defaults["baselines"]}
    different: dict[str, Any] = {}
    for stage, values in settings.items():
        # The settings of a baseline's training are those of the section of its model.
        of_model = models.get(values.get("model"), defaults)
        different |= _different(values, pictures if stage in PICTURE_STAGES else of_model, stage)
    return {name: value for name, value in sorted(different.items()) if not name.endswith(".seed")}


def _different(values: Mapping[str, Any], defaults: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    different: dict[str, Any] = {}
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            different |= _different(value, default, f"{prefix}.{name}")
        elif name not in defaults or value != default:
            different[f"{prefix}.{name}"] = value
    return different


def rerun(results: Path, scenario: str, method: str, seed: int, record: RunRecord | None, configfiles: Sequence[str] = ()) -> str:
    """The command that makes a run again with all its stages, or that continues one without a record."""
    target = f"{results}/{scenario}/{method}/{seed}/run.json"
    words = ["snakemake", target, "--profile", "workflow/profiles/default", "--cores", "1"]
    words += ["--configfile", *configfiles] if configfiles else []
    words += ["--config", f"results={results}", f"only=scenario={scenario} method={method} seed={seed}"]
    if record:
        # A baseline's model has its own rule for the rollout.
        rules = ["predict" if record.model and stage == "rollout" else stage for stage in record.settings]
        words += [f"device={record.device.partition(':')[0]}", "--forcerun", *rules, "score"]
    return shlex.join(words)


MOST = 12
"""Runs that are listed."""
SHORT = 12
"""Characters of a digest; --json has all."""

COMMANDS = """Commands make the run and all its stages again and replace these files: check out the commit of the run first.
To keep the files, give another folder: --config results=... The commands need the --configfile and --config of the
benchmark; give --configfile to this command too. The same seed on the same type of device gives the same run_key."""


def text(explanation: Explanation) -> str:
    """The value, the runs behind it, the runs left out, and what is not as recorded."""
    metric = IN_STUDIES[explanation.row["metric"]]
    lines = [f"{explanation.cell} (method {explanation.row['method']})", "", *_value(explanation, metric), ""]
    lines += _runs(explanation.runs)
    if explanation.not_applying:
        lines += ["", *left_out_lines({explanation.row["method"]: explanation.not_applying})]
    elif not explanation.runs and not explanation.left_out:
        lines.append(f"{explanation.row['method']} was not among the methods of the benchmark.")
    if explanation.left_out:
        lines += ["", f"Left out: {len(explanation.left_out)}", ""]
        lines += [f"- {run.scenario} / seed {run.seed}: {run.why}{_command(run)}" for run in explanation.left_out]
    if explanation.runs:
        lines += ["", 'In MLflow (`neuspring ui`), a run has the tag run_key: search for tags.run_key = "...".']
        lines.append(COMMANDS)
    checked = sum(run.files for run in explanation.runs)
    lines += ["", f"{checked} files compared with their digests; {len(explanation.problems) or 'nothing'} not as recorded"]
    lines += [f"- {problem}" for problem in explanation.problems]
    return "\n".join(lines) + "\n"


def _value(explanation: Explanation, metric: Metric) -> list[str]:
    cell: Any = SimpleNamespace(**{name: np.nan if value is None else value for name, value in explanation.row.items()})
    unit = f" {metric.paper_unit}" * bool(metric.paper_unit)
    kind = "scenarios weigh equally" if metric.average == "equal" else "scenarios weigh by their frames"
    ours = f"ours     {metric.paper_text(cell.ours)}{unit}"
    lines = [ours]
    if np.isfinite(cell.ours):
        lines = [f"{ours} ({cell.ours!r}): {cell.scenarios} scenarios, {cell.seeds} seeds, {kind}"]
        lines.append(f"         the other average: {metric.paper_text(cell.other_average)}{unit}")
    if np.isfinite(cell.spread):
        lines.append(f"         ± {metric.paper_text(cell.spread)} over seeds")
    if np.isfinite(cell.low):
        lines.append(f"         95 % bootstrap interval: [{metric.paper_text(cell.low)}, {metric.paper_text(cell.high)}]")
    difference = metric.paper_text(cell.difference, "+")
    if explanation.cell.partition("/")[0] != BENCHMARK:
        lines.append(f"paper    {cell.paper or DASH}{unit * bool(cell.paper)}; ours - paper: {difference}")
        lines.append(f"verdict  {cell.verdict}")
    if cell.label != cell.baseline:
        change = f"paper {paper_change(cell, metric)}, ours {our_change(cell, metric)}"
        lines.append(f"change   against {cell.baseline}: {change}: {cell.direction}")
    return lines


def _runs(runs: Sequence[Behind]) -> list[str]:
    if not runs:
        return ["No run counts."]
    header = ["Scenario", "Seed", "Value", "Frames", "Status", "Commit", "Device", "Data", "Settings", "Files"]
    groups = {canonical(run.settings): run for run in runs}
    rows = [
        [
            run.scenario,
            str(run.seed),
            repr(run.value),
            str(run.frames),
            run.status,
            _commit(str(run.facts.get("commit", ""))),
            str(run.facts.get("device", "?")),
            str(run.facts.get("data_digest", "?"))[:SHORT],
            _digest(run),
            f"{len(run.problems)} not as recorded" if run.problems else "as recorded",
        ]
        for run in runs
    ]
    lines = [f"{len(runs)} runs behind it:", "", *Table.of_texts(header, rows).markdown()]
    for run in groups.values():
        changed = [f"  {name}: {json.dumps(value)}" for name, value in run.settings.items()]
        lines += ["", f"Settings {_digest(run)} that differ from the defaults:", *(changed or ["  none"])]
    lines.append("")
    for run in runs:
        lines += [f"{run.record}", f"  run_key {run.facts.get('run_key', '?')}, {run.facts.get('machine', '?')}{_command(run)}"]
    return lines


def _command(run: Behind) -> str:
    return f"\n  {run.command}" if run.command else ""


def _commit(name: str) -> str:
    digest, dash, dirty = name.partition("-")
    return f"{digest[:SHORT]}{dash}{dirty}" or "unknown"


def _digest(run: Behind) -> str:
    return hashlib.sha256(canonical(run.settings).encode()).hexdigest()[:SHORT]
