"""The verdict on each study, then its tables, as `neuspring study` writes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import pandas as pd

from neuspring.core.table import Tone
from neuspring.report.blocks import Answer, Block, Fold, Grid, PageSection
from neuspring.report.data import ReportData, ReportSection, several
from neuspring.report.grid import chip
from neuspring.report.study import study_blocks
from neuspring.scores import paper, study
from neuspring.scores.study import StudyNumbers, verdict_text

Kind = study.Verdict
WITHOUT_DIRECTION = (Kind.NOT_RUN, Kind.NOT_COMPUTED, Kind.NOTHING_TO_COMPARE, Kind.NO_BASELINE, Kind.ORACLE)
"""Verdicts on a change that name no direction."""


def studies(material: ReportData) -> PageSection | None:
    """Cards with the answers, and a fold per study; None without any."""
    found = material.numbers.by_study.values()
    if not found or not len(material.collected.runs):
        return None
    cards = [answer_card(one) for one in found if isinstance(one, StudyNumbers) and one.study.reference]
    folds = []
    for one in found:
        blocks: list[Block] = study_blocks(one) if isinstance(one, StudyNumbers) else one.blocks()
        folds.append(Fold(summary=f"{one.name}: {one.study.title}", blocks=blocks, open=True, key=f"study-{one.name}"))
    about = f"{_foreign(material.collected.runs)} The command neuspring explain STUDY/ROW/TASK/METRIC says what a cell is made of."
    return PageSection(
        key="studies", title="The paper's tables", blocks=[Grid(blocks=cards, least=17), *folds], about=about.strip()
    )


def _foreign(runs: pd.DataFrame) -> str:
    """A sentence on data that are not all PhysTwin's, by the sources of finished runs; empty if they are."""
    counts = runs[runs["source"] != ""].groupby("source")["scenario"].nunique().to_dict()
    if set(counts) == {"phystwin"}:
        return ""
    named = ", ".join(f"{source} ({several(int(count), 'scenario')})" for source, count in counts.items()) or "unknown"
    part = "only partly" if "phystwin" in counts else "not"
    return f"The data are {part} the paper's: {named}. Compare changes against a baseline, not values."


def answer_card(numbers: StudyNumbers) -> Answer:
    """The answer of a study of the paper."""
    name, cells = numbers.name, numbers.cells
    printed = cells[cells["paper"] != ""]
    changed = printed[(printed["label"] != numbers.study.baseline) & ~printed["direction"].isin(WITHOUT_DIRECTION)]
    changes = [f"{way} ({count})" for way, count in Counter(changed["direction"]).most_common()]
    small = [f"Change against {numbers.study.baseline}: {', '.join(changes)}"] if changes else []
    if printed["partial"].any():
        small.append(f"Partial: fewer than the paper's {len(paper.scenarios())} scenarios are finished.")
    given, tone = answer(Counter(printed["verdict"]), len(printed))
    counts = Counter((row["verdict"], verdict_text(row)) for row in printed.to_dict("records"))  # type: ignore[arg-type]
    chips = [chip(verdict, f"{count} {words}") for (verdict, words), count in counts.most_common()]
    return Answer(title=f"{name}: {numbers.study.title}", answer=given, tone=tone, chips=chips, small=small, target=f"study-{name}")


def answer(counts: Mapping[str, int], total: int) -> tuple[str, Tone]:
    """The answer that the counts of verdicts on values give, in words, with its tone; it claims no more than its cells."""
    agree, worse = (sum(counts.get(name, 0) for name in names) for names in ((Kind.WITHIN, Kind.BETTER), (Kind.WORSE,)))
    if not (answered := agree + worse):
        if counts.get(Kind.OTHER_DATA):
            return "Cannot be said: these are not the paper's data.", "mute"
        return ("Cannot be said yet: no interval.", "warn") if counts.get(Kind.NO_INTERVAL) else ("Not run yet.", "mute")
    tone: Tone = "good" if not worse and answered == total else "bad" if worse > agree else "warn"
    if agree == total:
        return f"Reproduced: all {total} cells are within the interval or better.", tone
    return f"{agree} of {total} cells within the interval or better, {worse} worse, {total - answered} open.", tone


section = ReportSection(order=55, make=studies)
