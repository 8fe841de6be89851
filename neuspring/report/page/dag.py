"""The workflow as a drawing: its steps, what feeds what, and how much of each is on disk."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup

from neuspring.report.page.blocks import Block, Cell, Drawing, Section, Table
from neuspring.report.page.sources import UNREADABLE, Material
from neuspring.report.page.words import DASH

WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN = 118, 58, 38, 34, 6
EDGE = 'fill="none" stroke="currentColor" stroke-width="1.2" opacity=".7" marker-end="url(#arrow)"'


@dataclass(frozen=True, kw_only=True)
class Step:
    """A rule of the workflow."""

    place: tuple[int, int]
    """Column and row of its box."""
    pattern: str
    """What it leaves in the results, {scenario} filled in; {tables} for the whole."""
    after: tuple[str, ...] = ()
    optional: bool = False
    """Not drawn where nothing of it is there."""
    checked: bool = False
    """Its record says whether it failed."""
    without: tuple[str, ...] = ()
    """What it follows where no step of `after` is drawn."""
    of_model: bool | None = None
    """Of records that two steps write: only those of baselines' models, or only those of twins."""


STEPS = {
    "capture": Step(place=(0, 0), pattern="{scenario}/capture/capture.json", optional=True),
    "segment": Step(place=(1, 0), pattern="{scenario}/perception/*/masks.json", after=("capture",), optional=True),
    "track": Step(place=(2, 0), pattern="{scenario}/perception/*/tracks.json", after=("segment",), optional=True),
    "lift": Step(place=(3, 0), pattern="{scenario}/perception/lifted.json", after=("track",), optional=True),
    "observe": Step(place=(0, 1), pattern="{scenario}/observations.npz", after=("lift",)),
    "search": Step(place=(1, 1), pattern="{scenario}/search-*/*/search.json", after=("observe",), checked=True),
    "fit": Step(place=(2, 1), pattern="{scenario}/*/*/fit.json", after=("search",), checked=True),
    "rollout": Step(place=(3, 1), pattern="{scenario}/*/*/rollout.json", after=("fit",), checked=True, of_model=False),
    "train": Step(place=(2, 3), pattern="{scenario}/*/*/train.json", after=("observe", "appearance"), optional=True, checked=True),
    "predict": Step(
        place=(3, 3),
        pattern="{scenario}/*/*/rollout.json",
        after=("train",),
        without=("observe",),
        optional=True,
        checked=True,
        of_model=True,
    ),
    "score": Step(place=(4, 1), pattern="{scenario}/*/*/run.json", after=("rollout", "render", "predict"), checked=True),
    "tables": Step(place=(5, 1), pattern="{tables}/summary.md", after=("score",)),
    "appearance": Step(
        place=(2, 2), pattern="{scenario}/appearance*/*/appearance.json", after=("observe",), optional=True, checked=True
    ),
    "render": Step(
        place=(3, 2), pattern="{scenario}/*/*/render.json", after=("appearance", "rollout", "predict"), optional=True, checked=True
    ),
    "transfer": Step(place=(4, 0), pattern="{scenario}/*/*/transfer.json", after=("fit",), optional=True, checked=True),
    "log_run": Step(place=(5, 2), pattern="{scenario}/*/*/mlflow.txt", after=("score",), optional=True),
}
RULES = {"capture": ("capture", "synthesise")}
"""Steps that several rules make."""


@dataclass(frozen=True, kw_only=True)
class Count:
    """How much of a step is there."""

    finished: int
    failed: int
    """Records that say so: numerical failures."""
    jobs_failed: int
    expected: int | None


def counts(material: Material) -> dict[str, Count]:
    """Steps with what is on disk of the chosen scenarios; optional ones only where something is there."""
    failing = Counter(job.rule for job in material.jobs if job.failed)
    choice = material.choice
    expected = {"observe": len(choice.scenarios), "score": choice.size, "tables": 1}
    found = {}
    for name, step in STEPS.items():
        tones = _statuses(material, step)
        wrong = sum(failing[rule] for rule in RULES.get(name, (name,)))
        if step.optional and not tones and not wrong:
            continue
        total = sum(tones.values())
        found[name] = Count(finished=total, failed=tones["failed"], jobs_failed=wrong, expected=expected.get(name))
    return found


def _statuses(material: Material, step: Step) -> Counter[str]:
    patterns = [step.pattern.format(scenario=name, tables=material.tables) for name in material.choice.scenarios]
    tones: Counter[str] = Counter()
    for pattern in dict.fromkeys(patterns or [step.pattern.format(scenario="*", tables=material.tables)]):
        for path in material.results.glob(pattern):
            if not _chosen(material, step, path.relative_to(material.results).parts):
                continue
            status = "ok"
            if step.checked:
                try:
                    record = json.loads(path.read_text(encoding="utf-8"))
                    status, of_model = str(record["status"]), "model" in record.get("settings", {})
                except UNREADABLE as error:
                    material.lost(path, error)
                    continue
                if step.of_model not in (None, of_model):
                    continue
            tones["failed" if status == "failed" else "ok"] += 1
    return tones


def _chosen(material: Material, step: Step, parts: tuple[str, ...]) -> bool:
    """Fits may lie with a method that shares them; runs count only if they were chosen."""
    if step.pattern.endswith(("run.json", "mlflow.txt")):
        return parts[1] in material.choice.methods and parts[2] in map(str, material.choice.seeds)
    return True


def section(material: Material) -> Section:
    """The drawing, and its numbers as a table."""
    found = counts(material)
    about = "Boxes are rules of the workflow; numbers are what the results folder holds."
    blocks: list[Block] = [Drawing(svg=drawing(found), caption="Steps and what feeds what", wide=True), _table(found)]
    return Section(key="workflow", title="Workflow", about=about, blocks=blocks)


def _table(found: Mapping[str, Count]) -> Table:
    rows = []
    for name, count in found.items():
        numbers = (count.expected, count.finished, count.failed, count.jobs_failed)
        tones = ("", "", "bad" if count.failed else "", "bad" if count.jobs_failed else "")
        cells = [
            Cell(text=DASH if number is None else f"{number:,}", tone=tone)  # type: ignore[arg-type]
            for number, tone in zip(numbers, tones, strict=True)
        ]
        rows.append([Cell(text=name), *cells])
    header = ["Step", "Expected", "On disk", "of them failed numerically", "Failed jobs"]
    return Table(caption="Steps", header=header, rows=rows)


def drawing(found: Mapping[str, Count]) -> Markup:
    """SVG of the steps in `found`; rows that hold none take no place."""
    rows = sorted({STEPS[name].place[1] for name in found})
    columns = max(STEPS[name].place[0] for name in found) + 1
    corners = {
        name: (
            MARGIN + STEPS[name].place[0] * (WIDTH + GAP_X),
            MARGIN + rows.index(STEPS[name].place[1]) * (HEIGHT + GAP_Y),
        )
        for name in found
    }
    width = 2 * MARGIN + columns * WIDTH + (columns - 1) * GAP_X
    height = 2 * MARGIN + len(rows) * HEIGHT + (len(rows) - 1) * GAP_Y
    edges = [(before, name) for name in found for before in _before(name, found)]
    lines = [_edge(corners[before], corners[name]) for before, name in edges]
    boxes = [_box(name, *corners[name], count) for name, count in found.items()]
    words = "; ".join(f"{name}: {count.finished} done, {count.failed + count.jobs_failed} failed" for name, count in found.items())
    head = Markup('<svg viewBox="0 0 {} {}" role="img" aria-label="{}">').format(width, height, f"Steps of the workflow. {words}")
    arrow = Markup(
        '<defs><marker id="arrow" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="currentColor"/></marker></defs>'
    )
    return head + arrow + Markup("").join([*lines, *boxes]) + Markup("</svg>")


def _before(name: str, found: Mapping[str, Count]) -> list[str]:
    """The steps in `found` that a step follows."""
    step = STEPS[name]
    return [before for before in step.after if before in found] or [before for before in step.without if before in found]


def _edge(start: tuple[int, int], end: tuple[int, int]) -> Markup:
    """An arrow between two boxes: straight in a row, else from below or above into a free side."""
    (x0, y0), (x1, y1) = start, end
    middle = HEIGHT // 2
    if y0 == y1:
        path = f"M{x0 + WIDTH} {y0 + middle}H{x1 - 1}"
    elif x0 == x1:
        down = y1 > y0
        path = f"M{x0 + WIDTH // 2} {y0 + (HEIGHT if down else 0)}V{y1 - 1 if down else y1 + HEIGHT + 1}"
    elif x1 > x0:
        bend = x1 - GAP_X // 2
        path = f"M{x0 + WIDTH} {y0 + middle}H{bend}V{y1 + middle}H{x1 - 1}" if x1 - x0 <= WIDTH + GAP_X else _around(x0, y0, x1, y1)
    else:
        turn = y1 - GAP_Y // 2
        path = f"M{x0 + WIDTH // 2} {y0 + HEIGHT}V{turn}H{x1 + WIDTH // 2}V{y1 - 1}"
    return Markup('<path d="{}" {}/>').format(path, Markup(EDGE))


def _around(x0: int, y0: int, x1: int, y1: int) -> str:
    """A way to a box that is further than the next column: along the gap between the rows."""
    down = y1 > y0
    out, into = (y0 + HEIGHT, y1 + HEIGHT // 2) if down else (y0, y1 + HEIGHT // 2)
    return f"M{x0 + WIDTH // 2} {out}V{into}H{x1 - 1}"


def _box(name: str, x: int, y: int, count: Count) -> Markup:
    wrong = count.failed + count.jobs_failed
    done = f"{count.finished:,} done" if count.expected is None else f"{count.finished:,} of {count.expected:,}"
    complete = count.finished and (count.expected is None or count.finished >= count.expected)
    line = "var(--bad)" if wrong else "var(--good)" if complete else "var(--soft)"
    mark = "✗" if wrong else "✓" if complete else "…"
    state = f"{wrong:,} failed" if wrong else "none failed" if count.finished else "not begun"
    return Markup(
        '<g><rect x="{x}" y="{y}" width="{w}" height="{h}" rx="6" fill="var(--panel)" stroke="{line}" stroke-width="1.6"/>'
        '<text x="{left}" y="{first}" font-size="13" font-weight="600" fill="currentColor">{name}</text>'
        '<text x="{right}" y="{first}" font-size="13" text-anchor="end" fill="{line}">{mark}</text>'
        '<text x="{left}" y="{second}" font-size="11.5" fill="currentColor">{done}</text>'
        '<text x="{left}" y="{third}" font-size="11.5" fill="{ink}">{state}</text></g>'
    ).format(
        x=x, y=y, w=WIDTH, h=HEIGHT, line=line, left=x + 9, right=x + WIDTH - 9, first=y + 18, second=y + 35, third=y + 50,
        name=name, mark=mark, done=done, state=state, ink="var(--bad)" if wrong else "var(--soft)",
    )  # fmt: skip
