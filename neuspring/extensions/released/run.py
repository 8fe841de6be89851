"""Conformance with PhysTwin's release: the checks in their order, `neuspring check-data` and `verify-released`, and the report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from neuspring.checks.case import FINAL_DATA, Case, whole
from neuspring.config import ScenarioRow
from neuspring.core.artifacts import Observations
from neuspring.core.checks import Check
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.findings import Finding, note, refusal
from neuspring.core.table import Table
from neuspring.core.text import Progress
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.released import checks
from neuspring.extensions.released.checks import MEAN, Absent, Comparison, Outcome, Published, Tools, of_means, require
from neuspring.extensions.released.files import Released, parameter_findings, prediction_findings, read_checkpoint
from neuspring.intake import phystwin
from neuspring.intake.phystwin import released_cases
from neuspring.scores.lpips import Lpips

RELEASED_CHECKS = {
    1: "sizes of the case, and frame 0 of the released prediction",
    2: "springs rebuilt from the searched parameters",
    3: "scores of the released prediction",
    4: "deprojection of the tracked pixels",
    5: "scores of pictures of the released splats",
    6: "replay of the released checkpoint",
}
OUTCOMES: tuple[Outcome, ...] = ("passed", "failed", "measured", "skipped")
VERIFY_COLUMNS = (
    *("check", "scenario", "task", "quantity", "unit", "ours", "published", "difference", "tolerance"),
    *("outcome", "frames", "note"),
)
CASES_FOLDER = Path("data") / "different_types"
SELF_COLLIDING = ("cloth", "package")
"""Released cases with one of these words in their name use the cloth configuration, in which nodes collide with each other."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """All findings, and the report as text."""

    findings: tuple[Comparison, ...]
    text: str

    @property
    def status(self) -> int:
        """Exit status: 1 if a check failed, 2 if there was nothing to compare (skipped or measured alone), else 0."""
        outcomes = Counter(finding.outcome for finding in self.findings)
        return 1 if outcomes["failed"] else 0 if outcomes["passed"] else 2


def verify_released(
    root: Path,
    output: Path,
    *,
    scenarios: Sequence[str] = (),
    checks: Collection[int] = tuple(RELEASED_CHECKS),
    device: str = "auto",
    published: Published | None = None,
) -> Report:
    """Check the released results below `root` (the folder that holds data, experiments, ...); write the report to folder `output`.

    `scenarios` defaults to all that are there, `published` to the table that ships. A missing file skips a check of its scenario, a
    damaged one fails it, and the other checks go on. The report is written after every scenario. Raises InputError if there are no
    cases, and for unknown scenarios, checks and devices.
    """
    present = _present(root)
    if unknown := [name for name in scenarios if name not in present]:
        raise InputError("--scenarios", f"must be folders of {root / CASES_FOLDER}: {', '.join(present)}", ", ".join(unknown))
    if wrong := [check for check in checks if check not in RELEASED_CHECKS]:
        raise InputError("--checks", f"must be of {', '.join(map(str, RELEASED_CHECKS))}", wrong)
    device = resolve_device(device)
    metric = Lpips.cached(device) if 5 in checks else ""
    tools = Tools(published=published or Published.load(), device=device, lpips=metric)
    names, findings = list(dict.fromkeys(scenarios)) or present, list[Comparison]()
    progress = Progress("verify", len(names), every=0.0)
    for done, name in enumerate(names, start=1):
        case = Released(root=root, name=name)
        observations: Observations | Exception
        try:
            observations = read_observations(case)
        except (Absent, InputError) as error:
            observations = error
        findings += check_case(case, observations, sorted(set(checks)), tools)
        # After every scenario: all of them take hours on a CPU.
        complete = (*findings, *of_means(findings, tools.published))
        report = Report(findings=complete, text=_text(complete, names[:done], tools.published, tools.device))
        _write(report, output)
        progress.update(done, name)
    return report


def _present(root: Path) -> list[str]:
    folder = root / CASES_FOLDER
    if not folder.is_dir():
        raise InputError(folder, "the released data must be there", "no such folder", "Name the folder that holds `data`.")
    names = sorted(path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if not names:
        raise InputError(folder, "at least one case is required", "an empty folder")
    return names


def check_case(case: Released, observations: Observations | Exception, checks: Sequence[int], tools: Tools) -> list[Comparison]:
    """The findings of `checks` for one case. A check that cannot be carried out has one finding, skipped or failed.

    `observations`: the processed case, or the exception of `read_observations`.
    """
    findings = list[Comparison]()
    for number in checks:
        blank = Comparison(check=number, scenario=case.name, quantity=RELEASED_CHECKS[number])
        for function in _FUNCTIONS[number]:
            try:
                if isinstance(observations, Exception):
                    raise observations
                findings += function(case, observations, tools)
            except Absent as reason:
                findings.append(replace(blank, outcome="skipped", note=str(reason), file=reason.file))
            except (InputError, NumericalFailure) as error:
                findings.append(replace(blank, outcome="failed", note=str(error)))
    return findings


def read_observations(case: Released) -> Observations:
    """The processed case. Raises Absent if its files are missing, InputError if the reader refuses them."""
    require(case.root, case.folder / FINAL_DATA, case.folder / phystwin.SPLIT)
    row = ScenarioRow(
        scenario=case.name,
        source="phystwin",
        category=released_cases().get(case.name, {}).get("category", "unknown"),
        path=str(case.folder),
        self_collision=any(word in case.name for word in SELF_COLLIDING),
        ground=True,
    )
    return phystwin.read(row, case.folder)


_FUNCTIONS: dict[int, tuple[Callable[[Released, Observations, Tools], list[Comparison]], ...]] = {
    1: (checks.sizes, checks.first_frame),
    2: (checks.topology,),
    3: (checks.evaluator,),
    4: (checks.deprojection,),
    5: (checks.renderer,),
    6: (checks.simulator,),
}


def _write(report: Report, output: Path) -> None:
    rows = [[getattr(finding, name) for name in VERIFY_COLUMNS] for finding in report.findings]
    write_text(output / "verify.csv", pd.DataFrame(rows, columns=list(VERIFY_COLUMNS)).to_csv(index=False))
    traces = [
        {"check": f.check, "scenario": f.scenario, "quantity": f.quantity, "frame": frame, "value": value, "unit": f.unit}
        for f in report.findings
        if f.per_frame is not None
        for frame, value in enumerate(f.per_frame)
    ]
    frames = pd.DataFrame(traces, columns=["check", "scenario", "quantity", "frame", "value", "unit"])
    write_text(output / "verify_frames.csv", frames.to_csv(index=False))
    write_text(output / "verify.md", report.text)


def _text(findings: Sequence[Comparison], names: Sequence[str], published: Published, device: str) -> str:
    """The report in Markdown: counts, means, every check, and what was skipped and why."""
    there, missing = published.scenarios & set(names), sorted(published.scenarios - set(names))
    of = f"{len(there)} of the {len(published.scenarios)} that means were published over"
    # A few that are missing are worth their names; a few that are there are in the tables.
    without = f" (without {', '.join(missing)})" if 0 < len(missing) < len(there) else ""
    lines = [
        "# Conformance with the released PhysTwin",
        "",
        f"Scenarios: {len(names)}, {of}{without}. Device: {device}.",
        "Measured: there is no published number to compare with.",
        "",
        *_counts(findings),
    ]
    done = [finding for finding in findings if finding.outcome != "skipped"]
    if means := [finding for finding in done if finding.scenario == MEAN]:
        lines += ["", "## Means over scenarios", "", *_table(means)]
    for check, title in RELEASED_CHECKS.items():
        if own := [finding for finding in done if finding.check == check and finding.scenario != MEAN]:
            lines += ["", f"## {check}: {title}", "", *_table(own)]
            # How many scenarios follow each convention.
            notes = Counter(finding.note for finding in own if finding.note) if check == 4 else Counter()
            lines += [""] * (check == 4) + [
                f"- {note}: {count} of {notes.total()} scenarios" for note, count in sorted(notes.items())
            ]
    if reasons := _reasons(findings):
        lines += ["", "## Skipped", "", *reasons]
    return "\n".join([*lines, "", _verdict(findings), ""])


def _counts(findings: Sequence[Comparison]) -> list[str]:
    rows = []
    for check, title in RELEASED_CHECKS.items():
        outcomes = Counter(finding.outcome for finding in findings if finding.check == check)
        if outcomes:
            rows.append([f"{check}: {title}", *(str(outcomes[name]) for name in OUTCOMES)])
    return Table.of_texts(["Check", *(name.capitalize() for name in OUTCOMES)], rows).markdown()


def _table(findings: Sequence[Comparison]) -> list[str]:
    header = ["Scenario", "Quantity", "Ours", "Published", "Difference", "Tolerance", "Unit", "Outcome", "Note"]
    rows = []
    for f in findings:
        # Counts are whole.
        given = (f.ours, f.published, f.difference, f.tolerance)
        numbers = ["–" if v is None else f"{v:d}" if isinstance(v, int) else f"{v:.6g}" for v in given]
        rows.append([f.scenario, f"{f.task} {f.quantity}".strip(), *numbers, f.unit, f.outcome, f.note])
    return Table.of_texts(header, rows).markdown()


def _reasons(findings: Sequence[Comparison]) -> list[str]:
    """One line per check and reason, with the scenarios that it holds for."""
    groups: dict[tuple[int, str], list[str]] = {}
    for f in findings:
        if f.outcome == "skipped":
            what = "" if f.quantity == RELEASED_CHECKS[f.check] else f"{f.task} {f.quantity}: ".lstrip()
            groups.setdefault((f.check, what + f.note.replace(f.scenario, "<case>")), []).append(f.scenario)
    return [f"- {check}: {reason} ({len(names)}: {', '.join(names)})" for (check, reason), names in sorted(groups.items())]


def _verdict(findings: Sequence[Comparison]) -> str:
    outcomes = Counter(finding.outcome for finding in findings)
    counts = ", ".join(f"{outcomes[name]} {name}" for name in OUTCOMES)
    failed = sorted({f"{f.scenario} ({f.check})" for f in findings if f.outcome == "failed"})
    if failed:
        return f"{counts}. Failed: {', '.join(failed)}."
    return f"{counts}." if outcomes["passed"] else f"{counts}. Nothing could be compared."


OF_RESULTS, OF_DATA = (1, 2, 3, 4), (1, 4)
"""Checks of a case with a root, and of one without: it has no released results."""


def conformance(folder: Path, cases: Sequence[Case], found: Sequence[Finding]) -> Iterator[dict[str, Any]]:
    """Every departure of the cases of a folder from the release: damaged results, failed checks, and what could not be compared."""
    findings, compared, tools = list[Finding](), list[Comparison](), Tools(published=Published.load())
    for case in cases:
        of_case, more = _check_case(case, tools)
        compared, findings = compared + of_case, findings + more
    if len(cases) > 1:
        findings += [_finding(mean, folder) for mean in of_means(compared, tools.published)]
    errors = [one for one in found if one.level == "error"]
    for one in findings:
        # What a reader refuses is an error of the layout already; the reader's text goes on with the next move.
        if one.level != "error" or not any(one.where == e.where and one.message.startswith(e.message) for e in errors):
            yield {"text": one.message, "level": one.level, "where": one.where}


RELEASED = Check("released results", "cases", conformance, None, "error", "{text}", title="")
"""Check of released results beside a case, for `check-data`: entry point `released` of the group `neuspring.checks`."""


def _check_case(given: Case, tools: Tools) -> tuple[list[Comparison], list[Finding]]:
    case = Released(root=given.root, name=given.name, loose=given.loose)
    findings = [] if case.loose else _of_results(case)
    if case.loose:
        findings.append(note(case.folder, "no experiments folder is known for this case: conformance checks 2 and 3 skipped"))
    try:
        observations = read_observations(case)
    except (Absent, InputError) as error:
        reason = [refusal(error)] if isinstance(error, InputError) else []
        return [], [*findings, *reason, note(case.folder, "the reader refuses this case: conformance checks 1 to 4 skipped")]
    compared = check_case(case, observations, OF_DATA if case.loose else OF_RESULTS, tools)
    return compared, findings + [_finding(one, one.file or case.folder) for one in compared]


def _of_results(case: Released) -> list[Finding]:
    """Released files that cannot be read; one that is missing skips the checks that need it."""
    findings: list[Finding] = []
    try:
        if case.parameters.exists():
            findings += parameter_findings(case.parameters, load_pickle(case.parameters))
        if case.checkpoint.exists():
            read_checkpoint(case.checkpoint)
        data = load_pickle(case.folder / FINAL_DATA) if case.prediction.exists() else None
        if data is not None and whole(data):
            nodes = data["object_points"].shape[1] + len(data["surface_points"]) + len(data["interior_points"])
            findings += prediction_findings(case.prediction, load_pickle(case.prediction), len(data["object_points"]), nodes)
    except InputError as error:
        findings.append(refusal(error))
    return findings


def _finding(compared: Comparison, file: Path) -> Finding:
    if compared.outcome == "failed" and compared.ours is None:  # a file that cannot be read
        return refusal(compared.note)
    check = f"check {compared.check}"
    if compared.outcome == "skipped":
        return note(file, f"{check} skipped, {compared.quantity}: {compared.note}")
    parts = [f"{check}, {f'{compared.task} {compared.quantity}'.strip()}: {_with_unit(compared.ours, compared.unit)}"]
    if compared.published is not None:
        verdict = "as" if compared.outcome == "passed" else "differs from"
        parts.append(f"{verdict} the released {_with_unit(compared.published, compared.unit)}")
    if compared.frames:
        parts.append(f"over {compared.frames} frames")
    text = ", ".join([*parts, *filter(None, [compared.note])])
    return Finding(name="", level="error" if compared.outcome == "failed" else "note", where=str(file), text=text)


def _with_unit(value: float | None, unit: str) -> str:
    return f"{value:.6f} {unit}" if unit else f"{value:g}"
