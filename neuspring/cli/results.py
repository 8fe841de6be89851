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

OnDisk = Annotated[tuple[str, ...], arg(help="all on disk by default")]
Names = Annotated[tuple[str, ...], arg(help="those of the settings, else all on disk, by default")]
Scores = Annotated[Path | None, arg(help="instead of run records: a scores.csv that tables wrote, on any machine")]
LeftOut = Annotated[str, arg(help="JSON: methods and the scenarios to which they do not apply, with reasons")]
RowTable = Annotated[Path, arg(help="this table of the configuration")]
ExtraRows = Annotated[tuple[Path, ...], arg(help="files with more rows of these tables")]
Folder = Annotated[Path, arg(help="folder to write to")]
Transfers = Annotated[tuple[str, ...], arg(help="scenarios whose twins were rolled out on other recordings")]
Tables = Annotated[str, arg(help="folder of tables in the results folder")]


def tables(
    output: Folder,
    results: Results = Path("results"),
    scenarios: OnDisk = (),
    methods: OnDisk = (),
    seeds: tuple[int, ...] = (),
    transfers: Transfers = (),
    baseline: Annotated[str | None, arg(help="method that others are compared with; the first by default")] = None,
    objects: Annotated[Literal["scenario", "category"], arg(help="what intervals of ratios are over")] = "scenario",
    aims: Annotated[str, arg(help="JSON: ratios that are aimed at (config/README.md, aims)")] = "[]",
    scores: Scores = None,
    left_out: LeftOut = "{}",
    method_table: RowTable = Path("config/methods.yaml"),
    extra_rows: ExtraRows = (),
    brief: Annotated[bool, arg(help="print the verdict alone")] = False,
) -> None:
    """Run records -> the long table of scores (scores.csv, runs.csv), and the benchmark's tables."""
    from neuspring.config.settings import Aim
    from neuspring.core.job_records import asked
    from neuspring.report import tables
    from neuspring.report.blocks import markdown
    from neuspring.report.data import traces
    from neuspring.scores.metrics import require_metrics
    from neuspring.scores.table import as_asked, collect

    wanted = tuple(parse(Aim, row, "--aims") for row in json_value("--aims", aims, list))
    require_metrics(wanted)
    absent = _read_left_out(left_out)
    common: Any = {"objects": objects, "aims": wanted, "names": tables.shown_names(method_table, extra_rows)}
    if scores:
        found = _read_scores(scores, scenarios, methods, seeds, left_out)
    else:
        there = traces(results)
        scenarios, methods, seeds = scenarios or tuple(there[0]), methods or tuple(there[1]), seeds or tuple(there[2])
        if not (scenarios and methods and seeds):
            raise InputError(results, "a results folder with runs is required", "none", "Run the workflow first, or name another.")
        found = as_asked(collect(results, scenarios, methods, seeds, absent, transfers), asked(results))
    numbers = tables.Compared(table=found, baseline=baseline or found.methods[0], **common)
    text = tables.write(numbers, output)
    print(markdown(tables.verdict(numbers)) if brief else text)
    print(f"Tables: {output / 'summary.md'}")


def _read_scores(path: Path, scenarios: Sequence[str], methods: Sequence[str], seeds: Sequence[int], left_out: str) -> ScoreTable:
    from neuspring.scores.table import read_scores

    found = read_scores(path).named(scenario=scenarios, method=methods, seed=seeds)
    return replace(found, left_out=_read_left_out(left_out))


def perception_table(
    scenarios: Annotated[str, arg(help="names and categories, as JSON")], output: Path, results: Results = Path("results")
) -> None:
    """Errors of perception, per category."""
    from neuspring.report import perception

    named = [(name, str(category)) for name, category in json_value("--scenarios", scenarios).items()]
    print(perception.write(perception.collect(results, named), output.parent))


def study(
    study: Annotated[str, arg(help="row of the study table")],
    output: Folder,
    results: Results = Path("results"),
    tables: Tables = "tables",
    scores: Scores = None,
    table: RowTable = Path("config/studies.yaml"),
    extra_rows: ExtraRows = (),
    scenarios: Annotated[tuple[str, ...], arg(help="a part of the scores")] = (),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    left_out: LeftOut = "{}",
) -> None:
    """The scores.csv that `tables` wrote -> one of the paper's tables, beside the paper's values."""
    from neuspring.report.study import write_study

    studies = read_studies(table, extra_rows)
    if study not in studies:
        raise InputError("study", f"must be a row of {table}", study, f"Known: {', '.join(studies)}")
    one = studies[study]
    if scores and one.kind:
        remedy = "Leave out --scores and name --results."
        raise InputError(f"study {study}", f"a study of the kind {one.kind} needs a results folder", "scores alone", remedy)
    found = _read_scores(scores or results / tables / "scores.csv", scenarios, methods, seeds, left_out)
    print(write_study(study, one, found, results, output))


def explain(
    what: Annotated[
        Positional[str], arg(help="names of a method, scenario, seed, task or metric, with / between: neuspring/future/TE")
    ],
    results: Results = Path("results"),
    tables: Tables = "tables",
) -> None:
    """A number -> the rows of scores.csv behind it, and the records of their runs."""
    from neuspring.core.table import lay_out
    from neuspring.report.tables import behind
    from neuspring.scores.table import read_scores

    found = behind(read_scores(results / tables / "scores.csv"), what.split("/"), results)
    print(f"{found.caption}\n\n{lay_out(found, 'text')}")


def report(
    output: Path,
    results: Results = Path("results"),
    scenarios: Names = (),
    methods: Names = (),
    seeds: tuple[int, ...] = (),
    transfers: Transfers = (),
    baseline: Annotated[str | None, arg(help="method that others are compared with")] = None,
    shown: Annotated[tuple[str, ...], arg(help="methods to draw; six at most by default")] = (),
    table: RowTable = Path("config/studies.yaml"),
    method_table: RowTable = Path("config/methods.yaml"),
    extra_rows: ExtraRows = (),
    tables: Tables = "tables",
    megabytes: Annotated[float, arg(help="size that pictures and videos may fill")] = 25.0,
    video_megabytes: Annotated[float, arg(help="part of it for videos; the others are linked")] = 8.0,
    left_out: LeftOut = "{}",
    settings: Settings = "{}",
) -> None:
    """Results folder -> one self-contained HTML file."""
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
    """Method -> scenarios to which it does not apply, and why, from JSON text. Raises InputError."""
    values: dict[str, dict[str, str]] = json_value("--left-out", text)
    if not all(isinstance(why, dict) and all(isinstance(reason, str) for reason in why.values()) for why in values.values()):
        raise InputError("--left-out", "must map methods to scenarios with reasons", text)
    return values


def sync(results: Results = Path("results"), settings: Settings = "{}") -> int:
    """Send to MLflow what is missing there; 1 where something could not be sent."""
    from neuspring.experiments.tracking import log

    outcomes = log.sync(results, read_settings(settings).tracking, progress=print)
    print("\n".join(f"{outcome}: {len(names)}" for outcome, names in outcomes.items()))
    return 1 if any(outcome.startswith(("unreachable", "damaged")) for outcome in outcomes) else 0


def ui(results: Results = Path("results"), settings: Settings = "{}", host: str = "127.0.0.1", port: int = 5000) -> None:
    """Open the MLflow UI of a results folder."""
    from neuspring.experiments.tracking.log import sync
    from neuspring.experiments.tracking.store import ENVIRONMENT, default_uri, page

    tracking = read_settings(settings).tracking
    uri, (place, empty) = tracking.uri or default_uri(results), page(results, tracking)
    if empty and tracking.uri is None:
        sync(results, tracking, print)
    if uri.startswith("http"):
        print(f"The tracking server is at {uri}/{place}")
        return
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InputError("--port", "must be free", f"{port} ({error.strerror})", f"Give another: --port {port + 1}.") from error
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", host, "--port", str(port)]
    # Each of MLflow's four processes imports all of it, and opens the index anew for the page that asks it first.
    command += ["--workers", "1"]
    server = subprocess.Popen(command, env=ENVIRONMENT | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"} | os.environ)
    with contextlib.suppress(KeyboardInterrupt):
        while server.poll() is None:
            with contextlib.suppress(OSError):
                socket.create_connection((host, port), timeout=1).close()
                print(f"MLflow UI: http://{host}:{port}/{place} (stop with Ctrl-C)", flush=True)
                break
            time.sleep(0.5)
        server.wait()
