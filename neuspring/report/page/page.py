"""The page: what it is about, its sections in order, and the file."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import now
from neuspring.core.run_record import RUN_RECORD
from neuspring.core.table import Tone
from neuspring.report import study_cells
from neuspring.report.benchmark import (
    Benchmark,
    Judging,
    breakdown_blocks,
    draw_clusters,
    draw_ratios,
    score_blocks,
    transfer_blocks,
)
from neuspring.report.blocks import Block, Facts, Fold, Grid, Picture, Section, Text, Verdict, html_page
from neuspring.report.draw.benchmark import CLUSTERS, RATIOS
from neuspring.report.page.curves import curves_section
from neuspring.report.page.material import (
    Choice,
    FinishedRun,
    ReportData,
    damaged_records,
    hours,
    job_records,
    listed,
    on_disk,
    several,
)
from neuspring.report.page.pictures import Media, embedded_png, pictures_section, wanted_pictures
from neuspring.report.page.setup import perception_section, setup_section, tuning_section
from neuspring.report.page.work import failures_section, findings_section, gpu_hours, work_section
from neuspring.report.study import StudyNumbers, kind, study_blocks, verdict_chip
from neuspring.report.study_cells import BETTER, WITHIN, WORSE
from neuspring.scores import paper
from neuspring.scores.failures import LeftOut
from neuspring.scores.paper import Study
from neuspring.scores.runs import collect, collect_transfers

MEGABYTE = 1_000_000
MARKUP = 400
"""Characters around an embedded picture."""
MOST_SHOWN = 6
"""Methods that are drawn unless others are asked for."""
ANSWERED = (WITHIN, BETTER, WORSE)
WITHOUT_DIRECTION = (study_cells.NOT_RUN, study_cells.NOT_COMPUTED, study_cells.NOTHING_TO_COMPARE, study_cells.NO_VALUE, ")")
"""Ends of verdicts on a change that name no direction; a bracket counts failed runs."""
Studies = Mapping[str, StudyNumbers]


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
    studies = _studies(material) if material.choice.size else {}
    sections = _sections(material, studies)
    sections |= _last(material, studies)
    # Pictures take the room that all else leaves.
    room = int(MEGABYTE * options.megabytes) - len(_page(material, list(sections.values()), written).encode())
    wanted = wanted_pictures(material)
    media = Media(material.output, wanted, room - MARKUP * len(wanted), int(MEGABYTE * options.video_megabytes))
    for path, reason in media.damaged.items():
        material.lost(path, reason)
    sections |= {"pictures": pictures_section(material, media)} | _last(material, studies)
    write_text(material.output, _page(material, list(sections.values()), written))
    return material.output


def _studies(material: ReportData) -> dict[str, StudyNumbers]:
    known = material.studies
    return {
        name: StudyNumbers(name=name, study=study, collected=material.collected, beside=known.get(study.beside or ""))
        for name, study in known.items()
    }


def _last(material: ReportData, studies: Studies) -> dict[str, Section]:
    """The sections that list damaged files; they are made last, because every other section may find some."""
    verdicts = [_verdict(numbers) for numbers in studies.values() if numbers.study.reference]
    return {"failures": failures_section(material), "verdict": _summary(material, verdicts)}


def gather(results: Path, output: Path, options: Options) -> ReportData:
    """Read what the report is about."""
    jobs, damaged = job_records(results)
    choice = _choice(results, options, on_disk(results, jobs))
    collected = collect(results, choice.scenarios, choice.methods, choice.seeds, choice.left_out)
    transfers = collect_transfers(results, choice.transfers, choice.methods, choice.seeds)
    damaged |= damaged_records(collected.runs, RUN_RECORD) | damaged_records(transfers.runs, "transfer.json")
    return ReportData(
        results=results,
        output=output,
        choice=choice,
        tables=options.settings.tables if options.settings else options.tables,
        settings=options.settings,
        studies=options.studies,
        collected=collected,
        runs=[FinishedRun(folder=results / record.name, record=record) for record in collected.records.values()],
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


def _sections(material: ReportData, studies: Studies) -> dict[str, Section]:
    """All in order, by key; those that depend on the others are empty."""
    parts = [
        _empty("verdict"),
        _study_section(studies) if studies else None,
        _score_section(material),
        curves_section(material),
        _empty("pictures"),
        findings_section(material),
        perception_section(material),
        tuning_section(material),
        work_section(material),
        _empty("failures"),
        setup_section(material),
    ]
    return {part.key: part for part in parts if part is not None}


def _empty(key: str) -> Section:
    return Section(key=key, title=key, blocks=[])


def _summary(material: ReportData, verdicts: Sequence[Block]) -> Section:
    runs, choice = material.collected.runs, material.choice
    title = "Did it reproduce?"
    if not choice.size:
        text = f"Nothing to report yet: {material.results.resolve().name} holds no run, and none was asked for."
        return Section(key="verdict", title=title, blocks=[Text(text=text, tone="warn")])
    status = runs["status"].value_counts().to_dict()
    damaged = f", or of {several(len(material.damaged), 'damaged file')}" if material.damaged else ""
    failed_jobs = sum(job.failed for job in material.jobs)
    spent, source = gpu_hours(material)
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


def _verdict(numbers: StudyNumbers) -> Verdict:
    """The answer of a study of the paper."""
    name, study, cells = numbers.name, numbers.study, numbers.cells
    printed = cells[cells["paper"] != ""]
    kinds = printed["verdict"].map(kind)
    counts = Counter(kinds)
    directions = Counter(printed.loc[printed["label"] != study.baseline, "direction"])
    changes = [f"{way} ({count})" for way, count in directions.most_common() if not way.endswith(WITHOUT_DIRECTION)]
    small = [f"Change against {study.baseline}: {', '.join(changes)}"] if changes else []
    if printed["verdict"].str.startswith("partial").any():
        small.append(f"Partial: fewer than the paper's {len(paper.scenarios())} scenarios are finished.")
    answer, tone = _answer(counts, len(printed))
    chips = [verdict_chip(verdict, f"{count} {verdict}") for verdict, count in counts.most_common()]
    return Verdict(title=f"{name}: {study.title}", answer=answer, tone=tone, chips=chips, small=small, target=f"study-{name}")


def _answer(counts: Counter[str], total: int) -> tuple[str, Tone]:
    answered = sum(counts[name] for name in ANSWERED)
    agree = counts[WITHIN] + counts[BETTER]
    if not answered:
        if counts[study_cells.OTHER_DATA]:
            return "Cannot be said: these are not the paper's data.", "mute"
        return ("Cannot be said yet: no interval.", "warn") if counts[study_cells.NO_INTERVAL] else ("Not run yet.", "mute")
    tone: Tone = "good" if not counts[WORSE] and answered == total else "bad" if counts[WORSE] > agree else "warn"
    if agree == total:
        return f"Reproduced: all {total} cells are within the interval or better.", tone
    return f"{agree} of {total} cells within the interval or better, {counts[WORSE]} worse, {total - answered} open.", tone


def _study_section(studies: Studies) -> Section:
    """The tables of the studies, as `neuspring study` writes them; those without any run are folded."""
    folds: list[Block] = []
    for name, numbers in studies.items():
        has_runs = len(numbers.cells) > 0 and bool(numbers.cells["ours"].notna().any())
        summary = f"{name}: {numbers.study.title}" + ("" if has_runs else " (not run)")
        folds.append(Fold(summary=summary, blocks=study_blocks(numbers), open=has_runs, key=f"study-{name}"))
    about = "The command neuspring explain STUDY/ROW/TASK/METRIC says what a cell is made of."
    return Section(key="studies", title="The paper's tables", blocks=folds, about=about)


def _score_section(material: ReportData) -> Section:
    """The benchmark's own tables and pictures, as `neuspring tables` writes them."""
    config = material.settings or Config()
    judging = Judging(objects=config.objects, aims=config.aims)
    benchmark = Benchmark(
        everything=material.collected, baseline=material.choice.baseline, judging=judging, transfers=material.transfers
    )
    if not len(material.collected.runs):
        return Section(key="scores", title="Scores", blocks=[Text(text="No run has finished.", tone="mute")])
    blocks = [*_figures(benchmark), *score_blocks(benchmark), *transfer_blocks(benchmark), *breakdown_blocks(benchmark)]
    return Section(key="scores", title="Scores", blocks=blocks)


def _figures(benchmark: Benchmark) -> list[Block]:
    """The pictures of ratios and of regions."""
    captions = {
        RATIOS: f"Ratio of every method's errors to those of {benchmark.baseline}",
        CLUSTERS: "Chamfer distance against the number of regions",
    }
    blocks: list[Block] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if len(benchmark.usable):
            draw_ratios(benchmark, folder)
            draw_clusters(benchmark.everything, folder)
        for file, caption in captions.items():
            if png := embedded_png(folder / file):
                blocks.append(Picture(caption=caption, alt=caption, data=png.uri, size=png.size, wide=True, paper=True))
    return blocks


def _page(material: ReportData, sections: Sequence[Section], written: str) -> str:
    choice = material.choice
    seeds = f"seeds {listed([str(seed) for seed in choice.seeds])}" if choice.seeds else "no seeds"
    numbers = f"{several(len(choice.scenarios), 'scenario')}, {several(len(choice.methods), 'method')}, {seeds}"
    return html_page("NeuSpring: report", f"{numbers}; {material.results.resolve().name}", sections, written=written)
