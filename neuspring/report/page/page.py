"""The page: what it is about, its sections in order, and the file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import now
from neuspring.core.run_record import RUN_RECORD
from neuspring.report.blocks import Block, Facts, Grid, Picture, Section, Text
from neuspring.report.page import curves, failures, findings, pictures, prose, scores, setup, studies, work
from neuspring.report.page.media import Media, embedded_png
from neuspring.report.page.sources import Choice, Material, Run, damaged_records, job_records, on_disk
from neuspring.report.page.words import hours, listed, several
from neuspring.report.render import html_page
from neuspring.report.tables.ratios import Judged, Judging, judged
from neuspring.report.tables.summary import compared, draw_clusters, draw_ratios
from neuspring.scores.failures import LeftOut
from neuspring.scores.runs import collect, collect_transfers
from neuspring.scores.studies import Study

MEGABYTE = 1_000_000
MARKUP = 400
"""Characters around an embedded picture."""
MOST_SHOWN = 6
"""Methods that are drawn unless others are asked for."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the report is about. What is left empty is taken from the settings, else from what lies in the results folder."""

    scenarios: Sequence[str] = ()
    methods: Sequence[str] = ()
    seeds: Sequence[int] = ()
    baseline: str | None = None
    """The method that others are compared with; None: the settings', else the first."""
    transfers: Sequence[str] = ()
    """Scenarios whose twins were rolled out on other recordings."""
    left_out: LeftOut = field(default_factory=dict)
    """Method to the scenarios to which it does not apply, so that it has no runs there."""
    shown: Sequence[str] = ()
    """Methods whose curves and pictures are shown; empty: the baseline and the first rows of the studies, six in all."""
    settings: Config | None = None
    studies: Mapping[str, Study] = field(default_factory=dict)
    tables: str = "tables"
    """Folder of tables in the results folder."""
    megabytes: float = 25.0
    """Largest size of the page. Pictures and videos that do not fit are linked."""
    video_megabytes: float = 8.0
    """Largest part of that for videos."""


def write(results: Path, output: Path, options: Options, written: str | None = None) -> Path:
    """Write the report of a results folder as one HTML file; returns its path.

    Raises InputError if the folder does not exist, or a method to show or to compare with is not among the methods.
    """
    results = Path(results)
    if not results.is_dir():
        raise InputError(results, "the results folder must exist", "no such folder", "Run the workflow first, or name another.")
    written = written or now()
    material = gather(results, Path(output), options)
    cells = studies.study_cells(material) if material.choice.size else {}
    sections = _sections(material, cells)
    sections |= _last(material, cells)
    # Pictures take the room that all else leaves.
    room = int(MEGABYTE * options.megabytes) - len(_page(material, list(sections.values()), written).encode())
    wanted = pictures.wanted(material)
    media = Media(material.output, wanted, room - MARKUP * len(wanted), int(MEGABYTE * options.video_megabytes))
    for path, reason in media.damaged.items():
        material.lost(path, reason)
    sections |= {"pictures": pictures.section(material, media)} | _last(material, cells)
    write_text(material.output, _page(material, list(sections.values()), written))
    return material.output


def _last(material: Material, cells: Mapping[str, pd.DataFrame]) -> dict[str, Section]:
    """The sections that list damaged files; they are made last, because every other section may find some."""
    verdicts = studies.verdicts(material, cells) if cells else []
    return {"failures": failures.section(material), "verdict": _summary(material, verdicts)}


def gather(results: Path, output: Path, options: Options) -> Material:
    """Read what the report is about."""
    jobs, damaged = job_records(results)
    choice = _choice(results, options, on_disk(results, jobs))
    collected = collect(results, choice.scenarios, choice.methods, choice.seeds, choice.left_out)
    transfers = collect_transfers(results, choice.transfers, choice.methods, choice.seeds)
    damaged |= damaged_records(collected.runs, RUN_RECORD) | damaged_records(transfers.runs, "transfer.json")
    return Material(
        results=results,
        output=output,
        choice=choice,
        tables=options.settings.tables if options.settings else options.tables,
        settings=options.settings,
        studies=options.studies,
        collected=collected,
        runs=[Run(folder=results / record.name, record=record) for record in collected.records.values()],
        transfers=transfers,
        jobs=jobs,
        damaged=damaged,
    )


def _choice(results: Path, options: Options, there: tuple[list[str], list[str], list[int]]) -> Choice:
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
    shown = tuple(name for name in methods if name in shown)
    transfers = tuple(options.transfers) or tuple(sorted({path.parts[-4] for path in results.glob("*/*/*/transfer.json")}))
    return Choice(
        scenarios=scenarios,
        methods=methods,
        seeds=seeds,
        baseline=baseline,
        transfers=tuple(name for name in transfers if name in scenarios),
        shown=shown,
        left_out=options.left_out,
    )


def _sections(material: Material, cells: Mapping[str, pd.DataFrame]) -> dict[str, Section]:
    """All in order, by key; those that depend on the others are empty."""
    usable, differences = compared(material.collected, material.choice.baseline)
    config = material.settings or Config()
    figures = judged(
        material.collected, material.choice.baseline, Judging(objects=config.objects, aims=config.aims), material.transfers
    )
    parts = [
        _empty("verdict"),
        studies.section(material, cells) if cells else None,
        _with_figures(material, scores.section(material, usable, differences, figures), usable, figures),
        curves.section(material),
        _empty("pictures"),
        findings.section(material),
        prose.perception(material),
        prose.tuning(material),
        work.section(material),
        _empty("failures"),
        setup.section(material),
    ]
    return {part.key: part for part in parts if part is not None}


def _empty(key: str) -> Section:
    return Section(key=key, title=key, blocks=[])


def _summary(material: Material, verdicts: Sequence[Block]) -> Section:
    runs, choice = material.collected.runs, material.choice
    title = "Did it reproduce?"
    if not choice.size:
        text = f"Nothing to report yet: {material.results.resolve().name} holds no run, and none was asked for."
        return Section(key="verdict", title=title, blocks=[Text(text=text, tone="warn")])
    status = runs["status"].value_counts().to_dict()
    damaged = f", or of {several(len(material.damaged), 'damaged file')}" if material.damaged else ""
    failed_jobs = sum(job.failed for job in material.jobs)
    spent, source = work.gpu_hours(material)
    facts = [
        (f"{status.get('ok', 0)} of {choice.size}", "runs finished", f"{status.get('missing', 0)} missing"),
        (f"{status.get('failed', 0)}", "failed runs", f"numerical{damaged}"),
        (f"{failed_jobs}", "failed jobs", f"of {len(material.jobs)}") if material.jobs else ("–", "failed jobs", "no job records"),
        ("–" if spent is None else hours(3600 * spent), "GPU-hours so far", source),
        (f"{len(choice.scenarios)} × {len(choice.methods)} × {len(choice.seeds)}", "scenarios × methods × seeds", ""),
    ]
    blocks: list[Block] = [*([Grid(blocks=verdicts, least=17)] if verdicts else []), Facts(facts=facts), _data(runs)]
    return Section(key="verdict", title=title, blocks=blocks)


def _data(runs: pd.DataFrame) -> Text:
    """Whether the data are PhysTwin's, by the sources of finished runs."""
    finished = runs[runs["source"] != ""]
    if not len(finished):
        return Text(text="No run has finished, so nothing is known of the data.", tone="mute")
    counts = finished.groupby("source")["scenario"].nunique().to_dict()
    named = ", ".join(f"{source} ({several(int(count), 'scenario')})" for source, count in counts.items())
    if set(counts) == {"phystwin"}:
        return Text(text=f"The data are PhysTwin's: {named}.", tone="good")
    text = f"The data are {'only partly' if 'phystwin' in counts else 'not'} PhysTwin's: {named}. "
    return Text(
        text=text + "Values beside the paper's are for orientation; changes against a baseline can be compared.", tone="warn"
    )


def _with_figures(material: Material, section: Section, usable: pd.DataFrame, figures: Judged) -> Section:
    """The section with the pictures of ratios and of regions, as `tables` draws them."""
    if not len(usable):
        return section
    size = f"{several(usable['scenario'].nunique(), 'scenario')}, {several(usable['seed'].nunique(), 'seed')}"
    captions = {
        "ratios.png": f"Ratio of every method's errors to those of {material.choice.baseline}",
        "clusters.png": "Chamfer distance against the number of regions",
    }
    blocks: list[Block] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        draw_ratios(figures, folder, size)
        draw_clusters(material.collected, folder)
        for file, caption in captions.items():
            png = embedded_png(folder / file)
            if png:
                blocks.append(Picture(caption=caption, alt=caption, data=png.uri, size=png.size, wide=True, paper=True))
    return Section(key=section.key, title=section.title, about=section.about, blocks=[*blocks, *section.blocks])


def _page(material: Material, sections: Sequence[Section], written: str) -> str:
    choice = material.choice
    seeds = f"seeds {listed([str(seed) for seed in choice.seeds])}" if choice.seeds else "no seeds"
    numbers = f"{several(len(choice.scenarios), 'scenario')}, {several(len(choice.methods), 'method')}, {seeds}"
    return html_page("NeuSpring: report", f"{numbers}; {material.results.resolve().name}", sections, written=written)
