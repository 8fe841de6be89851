"""Commands on finished runs: tables, perception-table, study, explain, report."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

from neuspring.cli import options as shared
from neuspring.cli.tracking import add_results
from neuspring.config import parse
from neuspring.core.errors import InputError


def tables_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring tables`."""
    add_results(parser)
    for name in ("scenarios", "methods"):
        parser.add_argument(f"--{name}", nargs="+", default=())
    parser.add_argument("--seeds", nargs="+", type=int, default=())
    parser.add_argument("--transfers", nargs="*", default=[], help="scenarios whose twins were rolled out on other recordings")
    parser.add_argument("--baseline", help="method that others are compared with (default: the first)")
    parser.add_argument("--objects", choices=("scenario", "category"), default="scenario", help="what intervals of ratios are over")
    parser.add_argument("--aims", metavar="JSON", default="[]", help="JSON: ratios that are aimed at (config/README.md, aims)")
    parser.add_argument("--scores", type=Path, help="instead of run records: a scores.csv that tables wrote, on any machine")
    _add_left_out(parser)
    shared.add_output(parser, "folder to write to")


def tables(a: Namespace) -> None:
    """`neuspring tables`."""
    from neuspring.config.settings import Aim
    from neuspring.report import benchmark, gallery
    from neuspring.scores.runs import collect, collect_transfers, read_scores

    aims = tuple(parse(Aim, row, "--aims") for row in shared.json_value("--aims", a.aims, list))
    judging = benchmark.Judging(objects=a.objects, aims=aims)
    if a.scores:
        scores = read_scores(a.scores)
        baseline = a.baseline or str(scores.runs["method"].iloc[0])
        print(benchmark.write(replace(scores, left_out=_read_left_out(a.left_out)), baseline, a.output, judging=judging))
        return
    if not (a.scenarios and a.methods and a.seeds):
        raise InputError("tables", "--scores, or --scenarios, --methods and --seeds of a results folder, are required")
    collected = collect(a.results, a.scenarios, a.methods, a.seeds, _read_left_out(a.left_out))
    transfers = collect_transfers(a.results, a.transfers, a.methods, a.seeds)
    print(benchmark.write(collected, a.baseline or a.methods[0], a.output, transfers, judging))
    print(f"Tables: {a.output / 'summary.md'}")
    finished = collected.runs.loc[collected.runs["status"] == "ok", "seed"].to_list()
    seed = next((seed for seed in a.seeds if seed in finished), a.seeds[0])
    print(f"Pictures and videos: {gallery.write(a.results, a.scenarios, a.methods, seed, collected, a.output)}")


def perception_table_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring perception-table`."""
    add_results(parser)
    parser.add_argument("--scenarios", required=True, help="names and categories, as JSON")
    shared.add_output(parser)


def perception_table(a: Namespace) -> None:
    """`neuspring perception-table`."""
    from neuspring.report import perception

    scenarios = [(name, str(category)) for name, category in shared.json_value("--scenarios", a.scenarios).items()]
    print(perception.write(perception.collect(a.results, scenarios), a.output.parent))


def study_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring study`."""
    parser.add_argument("--study", required=True, help="row of the study table")
    _add_study_table(parser)
    add_results(parser)
    parser.add_argument("--scenarios", nargs="+")
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int)
    parser.add_argument("--scores", type=Path, help="instead of run records: a scores.csv that tables wrote, on any machine")
    _add_left_out(parser)
    shared.add_output(parser, "folder to write to")


def study(a: Namespace) -> None:
    """`neuspring study`."""
    from neuspring.report import study
    from neuspring.scores.runs import read_scores
    from neuspring.scores.studies import read_studies

    studies = read_studies(a.table)
    if a.study not in studies:
        raise InputError("--study", f"must be a row of {a.table}", a.study, f"Known: {', '.join(studies)}")
    definition, left_out = studies[a.study], _read_left_out(a.left_out)
    beside = studies[definition.beside] if definition.beside else None
    if a.scores:
        collected = replace(read_scores(a.scores), left_out=left_out)
        print(study.write_collected(a.study, definition, collected, a.output, beside))
    elif a.scenarios and a.methods and a.seeds:
        print(study.write_study(a.study, definition, a.results, a.scenarios, a.seeds, a.methods, a.output, left_out, beside))
    else:
        raise InputError("study", "--scores, or --scenarios, --methods and --seeds of a results folder, are required")


def explain_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring explain`."""
    parser.add_argument("cell", help="STUDY/ROW/TASK/METRIC, for example table1/NeuSpring/future/chamfer")
    add_results(parser)
    parser.add_argument("--tables", default="tables", help="folder of the tables in the results folder")
    parser.add_argument("--configfile", nargs="+", default=(), help="files the benchmark was run with, for the commands")
    parser.add_argument("--json", action="store_true")


def explain(a: Namespace) -> int:
    """`neuspring explain`: exit status 1 if a run behind the cell has changed."""
    from neuspring.report import explain, explain_text

    explanation = explain.explain(a.cell, a.results, a.results / a.tables / "studies", a.configfile)
    print(explanation.as_json() if a.json else explain_text.text(explanation), end="")
    return 1 if explanation.problems else 0


def report_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring report`."""
    add_results(parser)
    for name in ("scenarios", "methods"):
        parser.add_argument(f"--{name}", nargs="+", default=(), help="those of the settings, else all on disk, by default")
    parser.add_argument("--seeds", nargs="+", type=int, default=())
    parser.add_argument("--transfers", nargs="*", default=(), help="scenarios whose twins were rolled out on other recordings")
    parser.add_argument("--baseline", help="method that others are compared with")
    parser.add_argument("--shown", nargs="+", default=(), help="methods to draw (default: six at most)")
    _add_study_table(parser)
    parser.add_argument("--tables", default="tables", help="folder of tables in the results folder")
    parser.add_argument("--megabytes", type=float, default=25.0, help="size that pictures and videos may fill")
    parser.add_argument("--video-megabytes", type=float, default=8.0, help="part of it for videos; the others are linked")
    _add_left_out(parser)
    shared.add_settings(parser)
    shared.add_output(parser)


def report(a: Namespace) -> None:
    """`neuspring report`."""
    from neuspring.report import page
    from neuspring.scores.studies import read_studies

    options = page.Options(
        scenarios=a.scenarios,
        methods=a.methods,
        seeds=a.seeds,
        baseline=a.baseline,
        transfers=a.transfers,
        left_out=_read_left_out(a.left_out),
        shown=a.shown,
        settings=None if a.settings == "{}" else shared.read_settings(a.settings),
        studies=read_studies(a.table),
        tables=a.tables,
        megabytes=a.megabytes,
        video_megabytes=a.video_megabytes,
    )
    print(f"Report: {page.write(a.results, a.output, options)}")


def _add_study_table(parser: ArgumentParser) -> None:
    parser.add_argument("--table", type=Path, default=Path("config/studies.yaml"), help="the study table")


def _add_left_out(parser: ArgumentParser) -> None:
    about = "JSON: methods and the scenarios to which they do not apply, where they have no runs"
    parser.add_argument("--left-out", metavar="JSON", default="{}", help=about)


def _read_left_out(text: str) -> dict[str, tuple[str, ...]]:
    """Method -> scenarios to which it does not apply, from JSON text. Raises InputError."""
    values = shared.json_value("--left-out", text)
    if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in values.values()):
        raise InputError("--left-out", "must map methods to lists of scenarios", text)
    return {method: tuple(names) for method, names in values.items() if isinstance(names, list)}
