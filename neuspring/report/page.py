"""The report: one HTML file that opens with the verdict in words, and shows everything a results folder holds.

It needs no network and no script. It is made from what is on disk, also while a benchmark runs, and lists the files that it cannot
read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.findings import warnings_of
from neuspring.core.job_records import asked
from neuspring.core.records import now
from neuspring.core.text import listed
from neuspring.registry import Registry, modules
from neuspring.report.blocks import PageSection, html_page
from neuspring.report.data import Options, ReportData, ReportSection, damaged_files, job_records, several, traces
from neuspring.scores.numbers import Numbers, kept_studies
from neuspring.scores.runs import Collected, as_asked, collect, collect_transfers

__all__ = ["REPORT_SECTIONS", "Options", "write"]
REPORT_SECTIONS: Registry[ReportSection] = Registry(
    "report_sections", modules("neuspring.report.sections", "section"), type=ReportSection
)
MEGABYTE = 1_000_000
LAST_OPEN = 40
"""Sections behind this place are folded."""
MOST_SHOWN = 6
"""Methods that are drawn unless others are asked for."""


def write(results: Path, output: Path, options: Options, written: str | None = None) -> Path:
    """Write the report of a results folder as one HTML file; returns its path.

    Numbers that were kept beside the page are taken, if they are of the same runs. Raises InputError without the folder, or if
    a method to show or to compare with is not among the methods.
    """
    results = Path(results)
    if not results.is_dir():
        raise InputError(results, "the results folder must exist", "no such folder", "Run the workflow first, or name another.")
    material, written = gather(results, Path(output), options), written or now()
    choice = material.choice
    seeds = f"seed{'s' * (len(choice.seeds) > 1)} {listed([*map(str, choice.seeds)])}" if choice.seeds else "no seeds"
    numbers = f"{several(len(choice.scenarios), 'scenario')}, {several(len(choice.methods), 'method')}, {seeds}"
    subtitle = f"{numbers}; {results.resolve().name}. Errors are in mm."
    ordered = sorted(REPORT_SECTIONS.items(), key=lambda pair: (pair[1].order, pair[0]))
    made: dict[str, PageSection | None] = {}

    def make(phase: int) -> None:
        made.update({name: section.make(material) for name, section in ordered if section.phase == phase})

    def page() -> str:
        there = [(one.order, section) for name, one in ordered if (section := made.get(name))]
        sections = [replace(section, folded=order > LAST_OPEN) for order, section in there]
        return html_page("NeuSpring: report", subtitle, sections, written=written)

    # Pictures take the room that all else leaves. What lists damaged files is made again last, because pictures may be damaged too.
    make(0)
    make(2)
    material.room = int(MEGABYTE * choice.megabytes) - len(page().encode())
    make(1)
    make(2)
    write_text(material.output, page())
    return material.output


def gather(results: Path, output: Path, options: Options) -> ReportData:
    """Read what the report is about."""
    jobs, messages = job_records(results)
    choice = _filled(results, options, traces(results))
    everything = collect(results, choice.scenarios, choice.methods, choice.seeds, choice.left_out)
    collected, part = as_asked(everything, asked(results))
    transfers = collect_transfers(results, choice.transfers, choice.methods, choice.seeds)
    damaged, config = damaged_files(results, collected, transfers, messages), choice.settings or Config()
    kept = kept_studies(output.parent)
    numbers = Numbers(
        everything=collected,
        baseline=choice.baseline or "",
        objects=config.objects,
        aims=config.aims,
        transfers=transfers,
        studies={name: one for name, one in choice.studies.items() if name in kept or _ran(collected, choice, name)},
        known_studies=choice.studies,
        results=results,
        names=choice.names,
        asked=part,
        warnings=warnings_of(results, choice.scenarios),
    )
    numbers = numbers.take(output.parent)
    return ReportData(
        results=results, output=output, choice=choice, collected=collected, numbers=numbers, jobs=jobs, damaged=damaged
    )


def _ran(collected: Collected, choice: Options, name: str) -> bool:
    """True where a study was asked for, or several of its rows ran on the paper's data."""
    runs = collected.runs[(collected.runs["status"] == "ok") & (collected.runs["source"] == "phystwin")]
    paired = set(runs["method"]) & set(choice.studies[name].rows.values())
    return len(paired) > 1 or (choice.settings is not None and name in choice.settings.studies)


def _filled(results: Path, options: Options, there: tuple[list[str], list[str], list[int]]) -> Options:
    """The options with nothing left empty; `there` is what lies in the results folder."""
    settings = options.settings or Config()
    in_studies = [method for study in options.studies.values() for method in study.rows.values()]
    on_disk = sorted(there[1], key=lambda name: in_studies.index(name) if name in in_studies else len(in_studies))
    scenarios = tuple(options.scenarios or settings.scenarios or there[0])
    methods = tuple(options.methods or settings.methods or on_disk)
    seeds = tuple(options.seeds or ((settings.seeds if options.settings else ()) or there[2]))
    for name in (*options.shown, *([options.baseline] if options.baseline else [])):
        if name not in methods:
            raise InputError("report", "methods that are drawn or compared with must be among the methods", name, listed(methods))
    # Unless it is given: what a study compares with, else the first method.
    offered = [options.baseline or settings.compare_with, *(study.rows[study.baseline] for study in options.studies.values())]
    baseline = next((name for name in [*offered, *methods] if name in methods), "")
    finished = {path.parts[-3] for path in results.glob("*/*/*/run.json")}
    ordered = dict.fromkeys([baseline, *(name for name in in_studies if name in methods), *methods])
    shown = options.shown or [name for name in ordered if name in finished][:MOST_SHOWN]
    transfers = options.transfers or sorted({path.parts[-4] for path in results.glob("*/*/*/transfer.json")})
    return replace(
        options,
        scenarios=scenarios,
        methods=methods,
        seeds=seeds,
        baseline=baseline,
        transfers=tuple(name for name in transfers if name in scenarios),
        shown=tuple(name for name in methods if name in shown),
    )
