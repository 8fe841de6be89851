"""The report: one HTML file that says whether the paper was reproduced, and shows everything a results folder holds.

It needs no network and no script. It is made from what is on disk, also while a benchmark runs, and lists the files that it cannot
read.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import now
from neuspring.core.table import Tone
from neuspring.report import study_cells
from neuspring.report.benchmark import Benchmark, breakdown_blocks, pictures, score_blocks, transfer_blocks
from neuspring.report.blocks import Block, Facts, Fold, Grid, Section, Text, Verdict, html_page
from neuspring.report.draw.sheet import DPI
from neuspring.report.sections.curves import curves_section
from neuspring.report.sections.data import Options, ReportData, damaged_files, hours, job_records, listed, several, traces
from neuspring.report.sections.pictures import Media, embedded, pictures_section
from neuspring.report.sections.setup import perception_section, setup_section, tuning_section
from neuspring.report.sections.work import failures_section, findings_section, gpu_hours, work_section
from neuspring.report.study import StudyNumbers, kind, study_blocks, verdict_chip
from neuspring.report.study_cells import BETTER, WITHIN, WORSE
from neuspring.scores import paper
from neuspring.scores.runs import collect, collect_transfers

__all__ = ["Options", "write"]
MEGABYTE = 1_000_000
MOST_SHOWN = 6
"""Methods that are drawn unless others are asked for."""
ANSWERED = (WITHIN, BETTER, WORSE)
WITHOUT_DIRECTION = (study_cells.NOT_RUN, study_cells.NOT_COMPUTED, study_cells.NOTHING_TO_COMPARE, study_cells.NO_VALUE, ")")
"""Ends of verdicts on a change that name no direction; a bracket counts failed runs."""
ORDER = ("verdict", "studies", "scores", "curves", "pictures", "findings", "perception", "tuning", "work", "failures", "setup")
Studies = Mapping[str, StudyNumbers]


def write(results: Path, output: Path, options: Options, written: str | None = None) -> Path:
    """Write the report of a results folder as one HTML file; returns its path.

    Raises InputError if the folder does not exist, or a method to show or to compare with is not among the methods.
    """
    results = Path(results)
    if not results.is_dir():
        raise InputError(results, "the results folder must exist", "no such folder", "Run the workflow first, or name another.")
    material, written = gather(results, Path(output), options), written or now()
    choice, known = material.choice, material.choice.studies
    studies = {
        name: StudyNumbers(name=name, study=study, collected=material.collected, beside=known.get(study.beside or ""))
        for name, study in (known.items() if choice.size else ())
    }
    made = [
        _study_section(studies) if studies else None,
        _score_section(material),
        curves_section(material),
        findings_section(material),
        perception_section(material),
        tuning_section(material),
        work_section(material),
        setup_section(material),
    ]
    parts = {section.key: section for section in made if section is not None}
    seeds = f"seeds {listed([str(seed) for seed in choice.seeds])}" if choice.seeds else "no seeds"
    numbers = f"{several(len(choice.scenarios), 'scenario')}, {several(len(choice.methods), 'method')}, {seeds}"
    subtitle = f"{numbers}; {results.resolve().name}"
    verdicts = [_verdict(one) for one in studies.values() if one.study.reference]

    def page(shown: Section) -> str:
        # The sections that list damaged files are made last, because every other section may find some.
        last = {"pictures": shown, "failures": failures_section(material), "verdict": _summary(material, verdicts)}
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


def _summary(material: ReportData, verdicts: Sequence[Block]) -> Section:
    runs, choice = material.collected.runs, material.choice
    title = "Did it reproduce?"
    if not choice.size:
        text = f"Nothing to report yet: {material.results.resolve().name} holds no run, and none was asked for."
        return Section(key="verdict", title=title, blocks=[Text(text=text, tone="warn")])
    status = runs["status"].value_counts().to_dict()
    damaged = f", or of {several(len(material.damaged), 'damaged file')}" if material.damaged else ""
    failed_jobs = sum(job.failed for job in material.jobs)
    facts = [
        (f"{status.get('ok', 0)} of {choice.size}", "runs finished", f"{status.get('missing', 0)} missing"),
        (f"{status.get('failed', 0)}", "failed runs", f"numerical{damaged}"),
        (f"{failed_jobs}", "failed jobs", f"of {len(material.jobs)}") if material.jobs else ("–", "failed jobs", "no job records"),
        (hours(3600 * gpu_hours(material.jobs)) if material.jobs else "–", "GPU-hours so far", "job records"),
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
    if not len(material.collected.runs):
        return Section(key="scores", title="Scores", blocks=[Text(text="No run has finished.", tone="mute")])
    config, choice = material.choice.settings or Config(), material.choice
    benchmark = Benchmark(
        everything=material.collected,
        baseline=choice.baseline or "",
        objects=config.objects,
        aims=config.aims,
        transfers=material.transfers,
    )
    blocks: list[Block] = []
    for _, caption, figure in pictures(benchmark) if len(benchmark.usable) else ():
        stream = io.BytesIO()
        figure.savefig(stream, dpi=DPI, format="png")
        blocks.append(embedded(stream.getvalue(), caption, caption, wide=True))
    blocks += [*score_blocks(benchmark), *transfer_blocks(benchmark), *breakdown_blocks(benchmark)]
    return Section(key="scores", title="Scores", blocks=blocks)
