"""Commands on finished runs (tables, perception-table, study, explain, report) and on MLflow (sync, ui)."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from neuspring.cli.options import Positional, Results, Settings, arg, json_value, read_settings
from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.scores.paper import read_studies

if TYPE_CHECKING:
    from collections.abc import Sequence

    from neuspring.scores.table import ScoreTable

OnDisk = Annotated[tuple[str, ...], arg(help="default: all in the results folder")]
Names = Annotated[tuple[str, ...], arg(help="default: from the settings, else all in the results folder")]
Scores = Annotated[Path | None, arg(help="read this scores.csv of `neuspring tables` instead of run records")]
LeftOut = Annotated[str, arg(help="JSON: method -> scenarios to which it does not apply -> reason")]
RowTable = Annotated[Path, arg(help="YAML table of the configuration")]
ExtraRows = Annotated[tuple[Path, ...], arg(help="files with more entries of the tables")]
Folder = Annotated[Path, arg(help="folder to write to")]
Transfers = Annotated[tuple[str, ...], arg(help="scenarios whose twins also predict other recordings (transfer)")]
Tables = Annotated[str, arg(help="folder of tables in the results folder")]


def tables(
    output: Folder,
    results: Results = Path("results"),
    scenarios: OnDisk = (),
    methods: OnDisk = (),
    seeds: tuple[int, ...] = (),
    transfers: Transfers = (),
    baseline: Annotated[str | None, arg(help="method that all methods are compared with; default: the first")] = None,
    objects: Annotated[
        Literal["scenario", "category"], arg(help="units over which the intervals of ratios are computed")
    ] = "scenario",
    aims: Annotated[str, arg(help="JSON list of target ratios (key aims in config/README.md)")] = "[]",
    scores: Scores = None,
    left_out: LeftOut = "{}",
    method_table: RowTable = Path("config/methods.yaml"),
    extra_rows: ExtraRows = (),
    brief: Annotated[bool, arg(help="print only the verdict")] = False,
) -> None:
    """Write the tables of a benchmark: scores.csv, runs.csv and summary.md."""
    from neuspring.config.settings import Aim
    from neuspring.core.job_records import asked
    from neuspring.report import tables
    from neuspring.report.blocks import markdown
    from neuspring.report.data import traces
    from neuspring.scores.metrics import require_metrics
    from neuspring.scores.table import as_asked, collect

    targets = tuple(parse(Aim, row, "--aims") for row in json_value("--aims", aims, list))
    require_metrics(targets)
    absent = _read_left_out(left_out)
    common: Any = {"objects": objects, "aims": targets, "names": tables.shown_names(method_table, extra_rows)}
    if scores:
        table = _read_scores(scores, scenarios, methods, seeds, left_out)
    else:
        present = traces(results)
        scenarios, methods, seeds = scenarios or tuple(present[0]), methods or tuple(present[1]), seeds or tuple(present[2])
        if not (scenarios and methods and seeds):
            raise InputError(results, "must contain runs", None, "Run the workflow first, or pass another folder with --results.")
        table = as_asked(collect(results, scenarios, methods, seeds, absent, transfers), asked(results))
    numbers = tables.Compared(table=table, baseline=baseline or table.methods[0], **common)
    text = tables.write(numbers, output)
    print(markdown(tables.verdict(numbers)) if brief else text)
    print(f"Tables: {output / 'summary.md'}")


def _read_scores(path: Path, scenarios: Sequence[str], methods: Sequence[str], seeds: Sequence[int], left_out: str) -> ScoreTable:
    from neuspring.scores.table import read_scores

    table = read_scores(path).named(scenario=scenarios, method=methods, seed=seeds)
    return replace(table, left_out=_read_left_out(left_out))


def perception_table(
    scenarios: Annotated[str, arg(help="JSON: names and categories")], output: Path, results: Results = Path("results")
) -> None:
    """Write a table of the errors of perception per category."""
    from neuspring.report import perception

    named = [(name, str(category)) for name, category in json_value("--scenarios", scenarios).items()]
    print(perception.write(perception.collect(results, named), output.parent))


def study(
    study: Annotated[str, arg(help="name in the study table")],
    output: Folder,
    results: Results = Path("results"),
    tables: Tables = "tables",
    scores: Scores = None,
    table: RowTable = Path("config/studies.yaml"),
    extra_rows: ExtraRows = (),
    scenarios: Annotated[tuple[str, ...], arg(help="default: all in the scores")] = (),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    left_out: LeftOut = "{}",
) -> None:
    """Write a table of the paper with the paper's values and ours, from the scores.csv of `neuspring tables`."""
    from neuspring.report.study import write_study

    studies = read_studies(table, extra_rows)
    if study not in studies:
        raise InputError("study", f"must be an entry of {table}", study, f"Choose from {', '.join(studies)}.")
    chosen = studies[study]
    if scores and chosen.kind:
        rule = f"a study of the kind {chosen.kind} requires a results folder"
        raise InputError(f"study {study}", rule, "--scores", "Pass --results instead.")
    score_table = _read_scores(scores or results / tables / "scores.csv", scenarios, methods, seeds, left_out)
    print(write_study(study, chosen, score_table, results, output))


def explain(
    what: Annotated[Positional[str], arg(help="methods, scenarios, seeds, tasks or metrics, separated by /: neuspring/future/TE")],
    results: Results = Path("results"),
    tables: Tables = "tables",
) -> None:
    """Print the rows of scores.csv behind a number, and the records of their runs."""
    from neuspring.core.table import lay_out
    from neuspring.report.tables import behind
    from neuspring.scores.table import read_scores

    rows = behind(read_scores(results / tables / "scores.csv"), what.split("/"), results)
    print(f"{rows.caption}\n\n{lay_out(rows, 'text')}")


def report(
    output: Path,
    results: Results = Path("results"),
    scenarios: Names = (),
    methods: Names = (),
    seeds: tuple[int, ...] = (),
    transfers: Transfers = (),
    baseline: Annotated[
        str | None, arg(help="method that all methods are compared with; default: from the settings, else the first")
    ] = None,
    shown: Annotated[tuple[str, ...], arg(help="methods with curves, images and videos; default: at most six")] = (),
    table: RowTable = Path("config/studies.yaml"),
    method_table: RowTable = Path("config/methods.yaml"),
    extra_rows: ExtraRows = (),
    tables: Tables = "tables",
    megabytes: Annotated[float, arg(help="maximum size of the page, MB; files that do not fit are linked")] = 25.0,
    video_megabytes: Annotated[float, arg(help="maximum size of the embedded videos, MB")] = 8.0,
    left_out: LeftOut = "{}",
    settings: Settings = "{}",
) -> None:
    """Write the report of a results folder, one self-contained HTML file."""
    from neuspring.report import page
    from neuspring.report.tables import shown_names

    options = page.Options(
        scenarios=scenarios,
        methods=methods,
        seeds=seeds,
        baseline=baseline,
        transfers=transfers,
        left_out=_read_left_out(left_out),
        shown=shown,
        settings=None if settings == "{}" else read_settings(settings),
        studies=read_studies(table, extra_rows),
        names=shown_names(method_table, extra_rows),
        tables=tables,
        megabytes=megabytes,
        video_megabytes=video_megabytes,
    )
    print(f"Report: {page.write(results, output, options)}")


def _read_left_out(text: str) -> dict[str, dict[str, str]]:
    """Parse JSON: method -> scenarios to which it does not apply -> reason. Raises InputError."""
    values: dict[str, dict[str, str]] = json_value("--left-out", text)
    if not all(
        isinstance(reasons, dict) and all(isinstance(reason, str) for reason in reasons.values()) for reasons in values.values()
    ):
        raise InputError("--left-out", "must map methods to scenarios, and scenarios to reasons", text)
    return values


def sync(results: Results = Path("results"), settings: Settings = "{}") -> int:
    """Log all runs that MLflow does not contain yet; exit status 1 if a run could not be logged."""
    from neuspring.experiments.tracking import log

    outcomes = log.sync(results, read_settings(settings).tracking, progress=print)
    print("\n".join(f"{outcome}: {len(names)}" for outcome, names in outcomes.items()))
    return 1 if any(outcome.startswith(("unreachable", "damaged")) for outcome in outcomes) else 0


def ui(results: Results = Path("results"), settings: Settings = "{}", host: str = "127.0.0.1", port: int = 5000) -> None:
    """Open the MLflow UI of a results folder."""
    from neuspring.experiments.tracking.log import sync
    from neuspring.experiments.tracking.store import ENVIRONMENT, default_uri, page

    tracking = read_settings(settings).tracking
    uri, (address, empty) = tracking.uri or default_uri(results), page(results, tracking)
    if empty and tracking.uri is None:
        sync(results, tracking, print)
    if uri.startswith("http"):
        print(f"The tracking server is at {uri}/{address}")
        return
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InputError(
            "--port", "must be free", f"{port} ({error.strerror})", f"Choose another port: --port {port + 1}."
        ) from error
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", host, "--port", str(port)]
    # By default MLflow starts four processes, and each of them imports all of MLflow and opens the index again.
    command += ["--workers", "1"]
    server = subprocess.Popen(command, env=ENVIRONMENT | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"} | os.environ)
    with contextlib.suppress(KeyboardInterrupt):
        while server.poll() is None:
            with contextlib.suppress(OSError):
                socket.create_connection((host, port), timeout=1).close()
                print(f"MLflow UI: http://{host}:{port}/{address} (stop with Ctrl-C)", flush=True)
                break
            time.sleep(0.5)
        server.wait()
