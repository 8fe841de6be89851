"""`neuspring check-data`: the layout of a data folder, and checks 1 to 4 of its cases against what was released."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.data.check import check_layout, find_cases
from neuspring.data.departure import Departure, note
from neuspring.data.released import Released
from neuspring.scores.released.findings import Absent, Finding, Published, Tools, of_means
from neuspring.scores.released.run import check_case, read_observations

OF_RESULTS, OF_DATA = (1, 2, 3, 4), (1, 4)
"""Checks of a case with a root, and of one without: it has no released results."""


def check(folder: Path) -> list[Departure]:
    """Every departure of `folder` from its layout and from the release; nothing is raised for bad content.

    A failed check is an error, a measurement or a skipped check a note. Raises InputError if `folder` holds no data of a known
    layout.
    """
    departures, findings = check_layout(folder), list[Finding]()
    tools = Tools(published=Published.load())
    cases = find_cases(folder)
    for case in cases:
        case_findings, case_departures = _check_case(case, tools)
        findings += case_findings
        # What a reader refuses is an error of the layout already.
        departures += [d for d in case_departures if not (d.level == "error" and _is_among(d, departures))]
    if len(cases) > 1:
        departures += [_departure(mean, Path(folder)) for mean in of_means(findings, tools.published)]
    return departures


def _check_case(case: Released, tools: Tools) -> tuple[list[Finding], list[Departure]]:
    departures = []
    if case.loose:
        departures.append(note(case.folder, "no experiments folder is known for this case: conformance checks 2 and 3 skipped"))
    try:
        observations = read_observations(case)
    except (Absent, InputError) as error:
        reason = [Departure.of_error(error)] if isinstance(error, InputError) else []
        return [], [*reason, note(case.folder, "the reader refuses this case: conformance checks 1 to 4 skipped")]
    findings = check_case(case, observations, OF_DATA if case.loose else OF_RESULTS, tools)
    return findings, departures + [_departure(finding, finding.file or case.folder) for finding in findings]


def _is_among(error: Departure, departures: list[Departure]) -> bool:
    """Whether `departures` hold this error; the text of a reader's error goes on with the next move."""
    return any(error.file == d.file and error.message.startswith(d.message) for d in departures)


def _departure(finding: Finding, file: Path) -> Departure:
    if finding.outcome == "failed" and finding.ours is None:  # a file that cannot be read
        return Departure.of_error(finding.note)
    check = f"check {finding.check}"
    if finding.outcome == "skipped":
        return note(file, f"{check} skipped, {finding.quantity}: {finding.note}")
    parts = [f"{check}, {f'{finding.task} {finding.quantity}'.strip()}: {_number(finding.ours, finding.unit)}"]
    if finding.published is not None:
        verdict = "as" if finding.outcome == "passed" else "differs from"
        parts.append(f"{verdict} the released {_number(finding.published, finding.unit)}")
    if finding.frames:
        parts.append(f"over {finding.frames} frames")
    message = ", ".join([*parts, *filter(None, [finding.note])])
    return Departure(file, "error" if finding.outcome == "failed" else "note", message)


def _number(value: float | None, unit: str) -> str:
    return f"{value:.6f} {unit}" if unit else f"{value:g}"
