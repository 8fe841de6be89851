"""`neuspring check-data`: the layout of a data folder, and checks 1 to 4 of its cases against what was released."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, note, refusal
from neuspring.data.check import check_layout, find_cases
from neuspring.data.released import Released
from neuspring.scores.released.findings import Absent, Comparison, Published, Tools, of_means
from neuspring.scores.released.run import check_case, read_observations

OF_RESULTS, OF_DATA = (1, 2, 3, 4), (1, 4)
"""Checks of a case with a root, and of one without: it has no released results."""


def check(folder: Path) -> list[Finding]:
    """Every departure of `folder` from its layout and from the release; nothing is raised for bad content.

    A failed check is an error, a measurement or a skipped check a note. Raises InputError if `folder` holds no data of a known
    layout.
    """
    findings, compared = check_layout(folder), list[Comparison]()
    tools = Tools(published=Published.load())
    cases = find_cases(folder)
    for case in cases:
        of_case, more = _check_case(case, tools)
        compared += of_case
        # What a reader refuses is an error of the layout already.
        findings += [one for one in more if not (one.level == "error" and _is_among(one, findings))]
    if len(cases) > 1:
        findings += [_finding(mean, Path(folder)) for mean in of_means(compared, tools.published)]
    return findings


def _check_case(case: Released, tools: Tools) -> tuple[list[Comparison], list[Finding]]:
    findings = []
    if case.loose:
        findings.append(note(case.folder, "no experiments folder is known for this case: conformance checks 2 and 3 skipped"))
    try:
        observations = read_observations(case)
    except (Absent, InputError) as error:
        reason = [refusal(error)] if isinstance(error, InputError) else []
        return [], [*reason, note(case.folder, "the reader refuses this case: conformance checks 1 to 4 skipped")]
    compared = check_case(case, observations, OF_DATA if case.loose else OF_RESULTS, tools)
    return compared, findings + [_finding(one, one.file or case.folder) for one in compared]


def _is_among(error: Finding, findings: list[Finding]) -> bool:
    """Whether `findings` hold this error; the text of a reader's error goes on with the next move."""
    return any(error.where == one.where and error.message.startswith(one.message) for one in findings)


def _finding(compared: Comparison, file: Path) -> Finding:
    if compared.outcome == "failed" and compared.ours is None:  # a file that cannot be read
        return refusal(compared.note)
    check = f"check {compared.check}"
    if compared.outcome == "skipped":
        return note(file, f"{check} skipped, {compared.quantity}: {compared.note}")
    parts = [f"{check}, {f'{compared.task} {compared.quantity}'.strip()}: {_number(compared.ours, compared.unit)}"]
    if compared.published is not None:
        verdict = "as" if compared.outcome == "passed" else "differs from"
        parts.append(f"{verdict} the released {_number(compared.published, compared.unit)}")
    if compared.frames:
        parts.append(f"over {compared.frames} frames")
    text = ", ".join([*parts, *filter(None, [compared.note])])
    return Finding(name="", level="error" if compared.outcome == "failed" else "note", where=str(file), text=text)


def _number(value: float | None, unit: str) -> str:
    return f"{value:.6f} {unit}" if unit else f"{value:g}"
