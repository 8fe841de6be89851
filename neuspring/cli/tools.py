"""Commands around the workflow: data, tracking, comparisons."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.cli.options import Adder, add_left_out, read_left_out, read_settings
from neuspring.core.errors import InputError
from neuspring.core.files import write_text

if TYPE_CHECKING:
    from neuspring.config import Config
    from neuspring.config.tuning import Tune


def _sync(a: argparse.Namespace) -> int:
    from neuspring.experiments.tracking import log as tracking

    settings = read_settings(a.settings).tracking
    tracking.init(a.results, settings)
    outcomes = tracking.sync(a.results, settings, progress=print, under=a.under)
    counts = "\n".join(f"{outcome}: {len(names)}" for outcome, names in outcomes.items())
    print(counts)
    if a.output:
        # A step of the workflow: what could not be sent waits on disk and fails nothing.
        write_text(a.output, f"{counts}\n")
        return 0
    return 1 if any(outcome.startswith(("unreachable", "damaged")) for outcome in outcomes) else 0


def _compare(a: argparse.Namespace) -> int:
    from neuspring.core.provenance import commit_named
    from neuspring.experiments.tracking import compare

    first, second = commit_named(a.first), commit_named(a.second)
    print(compare.compare(a.results, read_settings(a.settings).tracking, first, second, a.output), end="")
    return 0


def _ui(a: argparse.Namespace) -> int:
    from neuspring.experiments.tracking import log as tracking

    uri = read_settings(a.settings).tracking.uri or tracking.default_uri(a.results)
    if uri.startswith("http"):
        print(f"The tracking server is at {uri}")
        return 0
    environment = os.environ | {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}
    environment.setdefault("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "false")
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", uri, "--host", a.host, "--port", str(a.port)]
    print(f"MLflow UI: http://{a.host}:{a.port} (stop with Ctrl-C)", flush=True)
    os.execve(sys.executable, command, environment)


def _check_data(a: argparse.Namespace) -> int:
    from neuspring.data import check

    departures = check.check(a.folder)
    print(check.render(departures))
    return 2 if any(departure.level == "error" for departure in departures) else 0


def _study(a: argparse.Namespace) -> int:
    from neuspring.report.tables import study as tables_paper
    from neuspring.scores import studies
    from neuspring.scores.runs import read_scores

    known = studies.read_studies(a.table)
    if a.study not in known:
        raise InputError("--study", f"must be a row of {a.table}", a.study, f"Known: {', '.join(known)}")
    left_out = read_left_out(a.left_out)
    if a.scores:
        collected = replace(read_scores(a.scores), left_out=left_out)
        text = tables_paper.write_collected(a.study, known[a.study], collected, a.output)
    elif a.scenarios and a.methods and a.seeds:
        text = tables_paper.write_study(a.study, known[a.study], a.results, a.scenarios, a.seeds, a.methods, a.output, left_out)
    else:
        raise InputError("study", "--scores, or --scenarios, --methods and --seeds of a results folder, are required")
    print(text)
    return 0


def _explain(a: argparse.Namespace) -> int:
    from neuspring.report import explain, explain_text

    found = explain.explain(a.cell, a.results, a.results / a.tables / "studies", a.configfile)
    print(found.as_json() if a.json else explain_text.text(found), end="")
    return 1 if found.problems else 0


def _report(a: argparse.Namespace) -> int:
    from neuspring.report import page as report
    from neuspring.scores import studies

    options = report.Options(
        scenarios=a.scenarios,
        methods=a.methods,
        seeds=a.seeds,
        baseline=a.baseline,
        transfers=a.transfers,
        left_out=read_left_out(a.left_out),
        shown=a.shown,
        settings=None if a.settings == "{}" else read_settings(a.settings),
        studies=studies.read_studies(a.table),
        tables=a.tables,
        megabytes=a.megabytes,
        video_megabytes=a.video_megabytes,
    )
    print(f"Report: {report.write(a.results, a.output, options)}")
    return 0


def _tune(a: argparse.Namespace) -> int:
    from neuspring.experiments.tuning import worker as tune

    chosen, study = _study_of(a)
    tune.work(chosen, study, a.observations, a.worker, a.device, a.output)
    return 0


def _tune_report(a: argparse.Namespace) -> int:
    from neuspring.experiments.tuning import report as tune_report

    chosen, study = _study_of(a)
    tune_report.report(chosen, study, a.output)
    print(a.output.read_text(encoding="utf-8"))
    return 0


def _study_of(a: argparse.Namespace) -> tuple[Config, Tune]:
    chosen = read_settings(a.settings)
    if chosen.tune is None:
        raise InputError("--settings, tune", "a tuning study is required", None, "See config/README.md, tune.")
    return chosen, chosen.tune


def _fetch(a: argparse.Namespace) -> int:
    from neuspring.data import check
    from neuspring.data.fetch import fetch

    departures = fetch.fetch(a.data_root, a.scenarios, a.parts, revision=a.revision, dry_run=a.dry_run)
    if a.dry_run:
        return 0
    print(check.render(departures))
    return 2 if any(departure.level == "error" for departure in departures) else 0


def _verify_released(a: argparse.Namespace) -> int:
    from neuspring.scores.released.run import CHECKS, verify_released

    lpips = read_settings(a.settings).images.lpips
    which = {"scenarios": a.scenarios, "checks": a.checks or tuple(CHECKS)}
    report = verify_released(a.data_root, a.output, **which, device=a.device, lpips=lpips)
    print(report.text, end="")
    return report.status


def add_commands(add: Adder) -> None:
    """Add these commands to the parser."""
    sync = add("sync", _sync, "send to MLflow what is missing there, and close runs that were killed", "results", "settings")
    sync.add_argument("--under", type=Path, help="only the records under this folder of the results")
    sync.add_argument("--output", type=Path, help="file for the counts; failures are then not an error")
    compare = add("compare", _compare, "runs of two commits, from MLflow -> paired differences", "results", "settings")
    compare.add_argument(
        "first", metavar="COMMIT_A", help="or a prefix, HEAD~1, a branch; a copy with changes is another commit, ...-dirty"
    )
    compare.add_argument("second", metavar="COMMIT_B")
    compare.add_argument("--output", type=Path, help="CSV file of the differences")
    ui = add("ui", _ui, "open the MLflow UI of a results folder", "results", "settings")
    ui.add_argument("--host", default="127.0.0.1")
    ui.add_argument("--port", type=int, default=5000)

    study = add("study", _study, "run records -> one of the paper's tables, beside the paper's values", "results", "output")
    study.add_argument("--scenarios", nargs="+")
    study.add_argument("--methods", nargs="+")
    study.add_argument("--seeds", nargs="+", type=int)
    study.add_argument("--scores", type=Path, help="instead of run records: a scores.csv that tables wrote, on any machine")
    add_left_out(study)
    study.add_argument("--study", required=True, help="row of the study table")
    study.add_argument("--table", type=Path, default=Path("config/studies.yaml"), help="the study table")

    explain = add("explain", _explain, "a cell of a study's table -> the runs behind it, and how to make them again", "results")
    explain.add_argument("cell", help="STUDY/ROW/TASK/METRIC, for example table1/NeuSpring/future/chamfer")
    explain.add_argument("--tables", default="tables", help="folder of the tables in the results folder")
    explain.add_argument("--configfile", nargs="+", default=(), help="files the benchmark was run with, for the commands")
    explain.add_argument("--json", action="store_true")
    page = add("report", _report, "results folder -> one self-contained HTML file", "results", "settings", "output")
    for name in ("scenarios", "methods"):
        page.add_argument(f"--{name}", nargs="+", default=(), help="those of the settings, else all on disk, by default")
    page.add_argument("--seeds", nargs="+", type=int, default=())
    page.add_argument("--transfers", nargs="*", default=(), help="scenarios whose twins were rolled out on other recordings")
    add_left_out(page)
    page.add_argument("--baseline", help="method that others are compared with")
    page.add_argument("--shown", nargs="+", default=(), help="methods to draw (default: six at most)")
    page.add_argument("--table", type=Path, default=Path("config/studies.yaml"), help="the study table")
    page.add_argument("--tables", default="tables", help="folder of tables in the results folder")
    page.add_argument("--megabytes", type=float, default=25.0, help="size that pictures and videos may fill up")
    page.add_argument("--video-megabytes", type=float, default=8.0, help="of it for videos; the others are linked")

    tune = add("tune", _tune, "one worker of a tuning study", "settings", "compute", "output")
    tune.add_argument("--observations", type=Path, nargs="+", required=True, help="observations.npz of the study's scenarios")
    tune.add_argument("--worker", type=int, default=0)
    add("tune-report", _tune_report, "a tuning study -> summary, plots, best.yaml", "settings", "output")

    fetch = add("fetch", _fetch, "released archives -> the folders that the readers expect")
    fetch.add_argument("source", choices=["phystwin"])
    fetch.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="all 22 by default")
    fetch.add_argument("--data-root", type=Path, required=True, help="folder to write to; data_root of the configuration")
    parts = "data, results, appearance, images, other; all: these five; extra: more clothes"
    fetch.add_argument("--parts", nargs="+", default=["data", "results"], help=f"{parts} (default: data results)")
    fetch.add_argument("--revision", default="main", help="branch, tag or commit of the data set")
    fetch.add_argument("--dry-run", action="store_true", help="say what would be fetched and the space it takes")
    verify = add(
        "verify-released", _verify_released, "PhysTwin's released results, checked against ours", "settings", "compute", "output"
    )
    verify.add_argument("data_root", type=Path, help="folder that holds data, experiments and their kin")
    verify.add_argument("--scenarios", nargs="+", default=(), help="all that are there by default")
    checks = "2 springs, 3 scores, 4 deprojection, 5 pictures, 6 replay; all by default"
    verify.add_argument("--checks", nargs="+", type=int, help=checks)
    check = add("check-data", _check_data, "report how a data folder departs from the expected layout")
    check.add_argument("folder", type=Path)
