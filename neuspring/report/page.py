"""The report: one HTML file that starts with the verdict and shows the content of a results folder.

The page requires neither network nor scripts. It is made from the files on disk, also while a benchmark runs, and lists unreadable
files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.job_records import asked, read_jobs
from neuspring.core.records import now
from neuspring.core.text import listed
from neuspring.registry import Registry, modules
from neuspring.report.blocks import PageSection, html_page
from neuspring.report.data import Options, ReportData, ReportSection, damaged_files, traces
from neuspring.report.tables import Compared, several
from neuspring.scores.table import as_asked, collect

__all__ = ["REPORT_SECTIONS", "Options", "write"]
REPORT_SECTIONS: Registry[ReportSection] = Registry(
    "report_sections", modules("neuspring.report.sections", "section"), type=ReportSection
)
LAST_OPEN, MOST_SHOWN = 30, 6


def write(results: Path, output: Path, options: Options, written: str | None = None) -> Path:
    """Write the report of a results folder as one HTML file; returns its path.

    Raises InputError if the folder does not exist, or if `shown` or `baseline` names a method that is not among the methods.
    """
    results = Path(results)
    if not results.is_dir():
        raise InputError(results, "the results folder must exist", None, "Run the workflow first, or pass another folder.")
    material, written = gather(results, Path(output), options), written or now()
    choice = material.choice
    counts = [several(len(getattr(choice, f"{noun}s")), noun) for noun in ("scenario", "method", "seed")]
    subtitle = f"{', '.join(counts)} in the folder {results.resolve().name}."
    ordered = sorted(REPORT_SECTIONS.items(), key=lambda pair: (pair[1].order, pair[0]))
    made = {}

    def make(phase: int) -> None:
        made.update({name: section.make(material) for name, section in ordered if section.phase == phase})

    def page() -> str:
        sections = [
            PageSection(key=name, title=section.title, blocks=blocks, about=section.about, folded=section.order > LAST_OPEN)
            for name, section in ordered
            if (blocks := made.get(name))
        ]
        return html_page("NeuSpring report", subtitle, sections, written=written)

    # Images fill the size that the other sections leave. Sections that list damaged files are made again, because reading images
    # may find more of them.
    make(0)
    make(2)
    material.room, material.film_room = int(1e6 * choice.megabytes) - len(page().encode()), int(1e6 * choice.video_megabytes)
    make(1)
    make(2)
    write_text(material.output, page())
    return material.output


def gather(results: Path, output: Path, options: Options) -> ReportData:
    """Read the data of the report."""
    messages: list[str] = []
    jobs = read_jobs(results, messages)
    choice = _filled(results, options)
    table = collect(results, choice.scenarios, choice.methods, choice.seeds, choice.left_out, choice.transfers)
    table = as_asked(table, asked(results))
    config = choice.settings or Config()
    more = {"objects": config.objects, "aims": config.aims, "names": choice.names}
    numbers = Compared(table=table, baseline=choice.baseline or "", **more)  # type: ignore[arg-type]
    damaged = damaged_files(table, messages, results)
    return ReportData(results=results, output=output, choice=choice, numbers=numbers, jobs=jobs, damaged=damaged)


def _filled(results: Path, options: Options) -> Options:
    """The options with all empty fields filled."""
    settings, available = options.settings or Config(), traces(results)
    in_studies = [method for study in options.studies.values() for method in study.rows.values()]
    on_disk = sorted(available[1], key=lambda name: in_studies.index(name) if name in in_studies else len(in_studies))
    scenarios = tuple(options.scenarios or settings.scenarios or available[0])
    methods = tuple(options.methods or settings.methods or on_disk)
    seeds = tuple(options.seeds or ((settings.seeds if options.settings else ()) or available[2]))
    for name in (*options.shown, *([options.baseline] if options.baseline else [])):
        if name not in methods:
            raise InputError(
                "report", "baseline and shown methods must be among the methods", name, f"Choose from {listed(methods)}."
            )
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
