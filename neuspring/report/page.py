"""The report: one HTML file that opens with the verdict in words, and shows everything a results folder holds.

It needs no network and no script. It is made from what is on disk, also while a benchmark runs, and lists the files that it cannot
read.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.findings import warnings_of
from neuspring.core.records import now
from neuspring.core.table import Tone
from neuspring.core.text import listed
from neuspring.report import study_cells
from neuspring.report.benchmark import Benchmark, detail_blocks, pictures, score_blocks
from neuspring.report.blocks import Block, Fold, Grid, Section, Text, Verdict, html_page
from neuspring.report.draw.sheet import DPI
from neuspring.report.sections.curves import curves_section
from neuspring.report.sections.data import Options, ReportData, damaged_files, job_records, several, traces
from neuspring.report.sections.pictures import Media, embedded, pictures_section
from neuspring.report.sections.setup import perception_section, setup_section, tuning_section
from neuspring.report.sections.work import failures_section, findings_section, work_section
from neuspring.report.study import StudyNumbers, kind, study_blocks, verdict_chip
from neuspring.report.study_cells import BETTER, WITHIN, WORSE
from neuspring.report.study_clips import clip_blocks, read_clips
from neuspring.report.verdict import verdict
from neuspring.scores import paper
from neuspring.scores.paper import Study
from neuspring.scores.runs import collect, collect_transfers

__all__ = ["Options", "write"]
MEGABYTE = 1_000_000
MOST_SHOWN = 6
"""Methods that are drawn unless others are asked for."""
ANSWERED = (WITHIN, BETTER, WORSE)
WITHOUT_DIRECTION = (study_cells.NOT_RUN, study_cells.NOT_COMPUTED, study_cells.NOTHING_TO_COMPARE, study_cells.NO_VALUE, ")")
"""Ends of verdicts on a change that name no direction; a bracket counts failed runs."""
ORDER = (
    *("verdict", "scores", "pictures", "curves", "details", "studies"),
    *("findings", "perception", "tuning", "work", "failures", "setup"),
)
Studies = Mapping[str, StudyNumbers]


def write(results: Path, output: Path, options: Options, written: str | None = None) -> Path:
    """Write the report of a results folder as one HTML file; returns its path.

    Raises InputError if the folder does not exist, or a method to show or to compare with is not among the methods.
    """
    results = Path(results)
    if not results.is_dir():
        raise InputError(results, "the results folder must exist", "no such folder", "Run the workflow first, or name another.")
    material, written = gather(results, Path(output), options), written or now()
    choice, known, config = material.choice, material.choice.studies, material.choice.settings or Config()
    studies = {
        name: StudyNumbers(name=name, study=study, collected=material.collected, beside=known.get(study.beside or ""))
        for name, study in (known.items() if choice.size else ())
        if _ran(material, name, study)
    }
    clips = {
        name: clip_blocks(read_clips(one.study, results, choice.scenarios, choice.seeds, choice.methods))
        for name, one in studies.items()
        if one.study.clips
    }
    benchmark = Benchmark(
        everything=material.collected,
        baseline=choice.baseline or "",
        objects=config.objects,
        aims=config.aims,
        transfers=material.transfers,
        warnings=warnings_of(results, choice.scenarios),
    )
    made = [
        _score_section(benchmark),
        curves_section(material),
        _detail_section(benchmark),
        _study_section(studies, clips, material.collected.runs) if studies else None,
        findings_section(material),
        perception_section(material),
        tuning_section(material),
        work_section(material),
        setup_section(material),
    ]
    parts = {section.key: section for section in made if section is not None}
    seeds = f"seed{'s' * (len(choice.seeds) > 1)} {listed([*map(str, choice.seeds)])}" if choice.seeds else "no seeds"
    numbers = f"{several(len(choice.scenarios), 'scenario')}, {several(len(choice.methods), 'method')}, {seeds}"
    subtitle = f"{numbers}; {results.resolve().name}. Errors are in mm."

    def page(shown: Section) -> str:
        # The sections that list damaged files are made last, because every other section may find some.
        last = {"pictures": shown, "failures": failures_section(material), "verdict": _summary(material, benchmark)}
        found = parts | last
        sections = [found[key] for key in sorted(found, key=ORDER.index)]
        return html_page("NeuSpring: report", subtitle, sections, written=written)

    # Pictures take the room that all else leaves.
    room = int(MEGABYTE * choice.megabytes) - len(page(Section(key="pictures", title="Pictures", blocks=[])).encode())
    media = Media(material, room, int(MEGABYTE * choice.video_megabytes))
    write_text(material.output, page(pictures_section(material, media)))
    return material.output


def gather(results: Path, output: Path, options: Options) -> ReportData:
    """Read what the report is about."""
    jobs, messages = job_records(results)
    choice = _filled(results, options, traces(results, jobs))
    collected = collect(results, choice.scenarios, choice.methods, choice.seeds, choice.left_out)
    transfers = collect_transfers(results, choice.transfers, choice.methods, choice.seeds)
    damaged = damaged_files(results, collected, transfers, messages)
    return ReportData(
        results=results, output=output, choice=choice, collected=collected, transfers=transfers, jobs=jobs, damaged=damaged
    )


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


def _summary(material: ReportData, benchmark: Benchmark) -> Section:
    """The verdict in words, first of all."""
    blocks: list[Block] = [*verdict(benchmark)] if material.choice.size else []
    if not blocks:
        text = f"Nothing to report yet: {material.results.resolve().name} holds no run, and none was asked for."
        blocks.append(Text(text=text, tone="warn"))
    failed, damaged = sum(job.failed for job in material.jobs), len(material.damaged)
    for count, noun, what in ((failed, "job", "failed"), (damaged, "file", "cannot be read")):
        if count:
            blocks.append(Text(text=f"{several(count, noun)} {what}: see Failures and missing runs.", tone="warn"))
    return Section(key="verdict", title="Verdict", blocks=blocks)


def _foreign(runs: pd.DataFrame) -> str:
    """A sentence on data that are not all PhysTwin's, by the sources of finished runs; empty if they are."""
    counts = runs[runs["source"] != ""].groupby("source")["scenario"].nunique().to_dict()
    if set(counts) == {"phystwin"}:
        return ""
    named = ", ".join(f"{source} ({several(int(count), 'scenario')})" for source, count in counts.items()) or "unknown"
    part = "only partly" if "phystwin" in counts else "not"
    return f"The data are {part} the paper's: {named}. Compare changes against a baseline, not values."


def _ran(material: ReportData, name: str, study: Study) -> bool:
    """Whether a study was asked for, or several of its rows ran on the paper's data."""
    settings = material.choice.settings
    table = material.results / material.choice.tables / "studies" / f"{name}.md"
    paired = {run.method for run in material.runs if run.ok and run.source == "phystwin"} & set(study.rows.values())
    return table.is_file() or len(paired) > 1 or (settings is not None and name in settings.studies)


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


def _study_section(studies: Studies, clips: Mapping[str, list[Block]], runs: pd.DataFrame) -> Section:
    """The verdict on each study, then its tables, as `neuspring study` writes them."""
    cards = [_verdict(one) for one in studies.values() if one.study.reference and not one.study.clips]
    blocks = {name: clips.get(name) or study_blocks(numbers) for name, numbers in studies.items()}
    folds = [
        Fold(summary=f"{name}: {numbers.study.title}", blocks=blocks[name], open=True, key=f"study-{name}")
        for name, numbers in studies.items()
    ]
    about = f"{_foreign(runs)} The command neuspring explain STUDY/ROW/TASK/METRIC says what a cell is made of."
    return Section(key="studies", title="The paper's tables", blocks=[Grid(blocks=cards, least=17), *folds], about=about.strip())


def _score_section(benchmark: Benchmark) -> Section:
    """The benchmark's own tables, as `neuspring tables` writes them."""
    some = len(benchmark.everything.runs)
    blocks = score_blocks(benchmark) if some else [Text(text="No run has finished.", tone="mute")]
    return Section(key="scores", title="Scores", blocks=blocks)


def _detail_section(benchmark: Benchmark) -> Section | None:
    """How sure the scores are, with a picture of the ratios."""
    if not len(benchmark.everything.runs):
        return None
    blocks: list[Block] = []
    for _, caption, figure in pictures(benchmark) if len(benchmark.usable) else ():
        stream = io.BytesIO()
        figure.savefig(stream, dpi=DPI, format="png")
        blocks.append(embedded(stream.getvalue(), caption, caption, wide=True))
    return Section(key="details", title="How sure the scores are", blocks=[*blocks, *detail_blocks(benchmark)])
