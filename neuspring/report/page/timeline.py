"""Which GPU did what when."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

from matplotlib.figure import Figure

from neuspring.core.job_records import Attempt, JobRecord
from neuspring.report.page import draw
from neuspring.report.page.blocks import Block, Drawing, Fold, Legend

MOST_LANES = 48
MOST_BARS = 1500
"""More bars than these are drawn as one picture of dots, not as lines that can be scaled."""
IDLE = 0.03
"""Part of the busy time that a pause keeps in the timeline."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """An attempt in the timeline; times in s since the epoch."""

    lane: tuple[str, str]
    rule: str
    start: float
    end: float
    ok: bool


def bars(jobs: Iterable[JobRecord]) -> list[Bar]:
    """Every finished attempt, once per GPU that it held; attempts on the CPU only where no job held a GPU."""
    found: dict[bool, list[Bar]] = {True: [], False: []}
    finished = [(job, attempt) for job in jobs for attempt in job.attempts if attempt.outcome != "running"]
    for job, attempt in finished:
        start = _epoch(attempt)
        if start is None or attempt.seconds <= 0:
            continue
        for device in attempt.devices or ["CPU"]:
            lane = (attempt.host, f"GPU {device}" if attempt.devices else "CPU")
            bar = Bar(lane=lane, rule=job.rule, start=start, end=start + attempt.seconds, ok=attempt.outcome == "ok")
            found[bool(attempt.devices)].append(bar)
    return sorted(found[True] or found[False], key=lambda bar: (bar.start, bar.end, bar.lane))


def _epoch(attempt: Attempt) -> float | None:
    try:
        return datetime.fromisoformat(attempt.started).timestamp()
    except ValueError:
        return None


def laned(found: Sequence[Bar]) -> list[tuple[str, list[Bar]]]:
    """Lanes in which no two bars overlap: one per GPU and job that it runs at once, or per job at once on the CPU."""
    lanes: dict[tuple[str, str], list[list[Bar]]] = defaultdict(list)
    for bar in found:
        # Starts are recorded to the second.
        free = next((row for row in lanes[bar.lane] if row[-1].end <= bar.start + 1.0), None)
        if free is None:
            lanes[bar.lane].append([bar])
        else:
            free.append(bar)
    hosts = {host for host, _ in lanes}
    named = []
    for (host, device), rows in sorted(lanes.items(), key=lambda item: (item[0][0], len(item[0][1]), item[0][1])):
        for index, row in enumerate(rows):
            name = f"{device}.{index + 1}" if len(rows) > 1 else device
            named.append((f"{host}, {name}" if len(hosts) > 1 else name, row))
    return named


def pauses(found: Sequence[Bar]) -> list[tuple[float, float]]:
    """(time, seconds cut out) of every pause in which nothing ran that is longer than a small part of the busy time."""
    spans: list[list[float]] = []
    for bar in found:
        if spans and bar.start <= spans[-1][1]:
            spans[-1][1] = max(spans[-1][1], bar.end)
        else:
            spans.append([bar.start, bar.end])
    kept = max(IDLE * sum(end - start for start, end in spans), 1.0)
    gaps = [(before[1], after[0] - before[1]) for before, after in itertools.pairwise(spans)]
    return [(start, length - kept) for start, length in gaps if length > kept]


def timeline(jobs: Sequence[JobRecord], rules: Sequence[str]) -> list[Block]:
    """Which job ran where and when, and how busy each lane was; nothing without timed attempts. Colours follow `rules`."""
    found = bars(jobs)
    if not found:
        return []
    cuts, lanes = pauses(found), laned(found)

    def place(time: float) -> float:
        return time - found[0].start - sum(length for start, length in cuts if start < time)

    total = max(place(bar.end) for bar in found)
    unit, size = ("h", 3600.0) if total > 3 * 3600 else ("min", 60.0) if total > 180 else ("s", 1.0)
    rules = [rule for rule in rules if any(bar.rule == rule for bar in found)]
    colours = {rule: draw.COLOURS[index % len(draw.COLOURS)] for index, rule in enumerate(rules)}
    shown = lanes[:MOST_LANES]
    with draw.styled():
        figure = Figure(figsize=(10, 0.26 * len(shown) + 0.8), layout="constrained", dpi=110)
        axis = figure.subplots()
        for row, (_, bars_here) in enumerate(shown):
            for rule in rules:
                spans = [(place(bar.start) / size, (bar.end - bar.start) / size) for bar in bars_here if bar.rule == rule]
                if spans:
                    axis.broken_barh(spans, (row - 0.38, 0.76), color=colours[rule], lw=0, rasterized=len(found) > MOST_BARS)
            wrong = [place(bar.end) / size for bar in bars_here if not bar.ok]
            axis.plot(wrong, [row] * len(wrong), ls="", marker="x", ms=5, mew=1.5, color=draw.INK)
        for start, _ in cuts:
            axis.axvline(place(start) / size, color=draw.INK, ls=":", lw=0.8)
        busy = [sum(bar.end - bar.start for bar in bars_here) / total for _, bars_here in shown]
        axis.set_yticks(range(len(shown)), [f"{name}  {100 * part:.0f} %" for (name, _), part in zip(shown, busy, strict=True)])
        axis.set(ylim=(len(shown) - 0.4, -0.6), xlim=(0, total / size), xlabel=f"time [{unit}]")
        axis.tick_params(length=0, axis="y")
        picture = draw.svg(figure, "timeline", f"Timeline of {len(found)} attempts in {len(lanes)} lanes")
    share = sum(bar.end - bar.start for bar in found) / (total * len(lanes))
    caption = f"Which job ran where; per cent: how busy; crosses: failed attempts. All lanes together: {100 * share:.0f} % busy."
    caption += f" Dotted: {len(cuts)} pauses cut out." if cuts else ""
    caption += f" {len(lanes) - len(shown)} lanes are not drawn." if len(lanes) > len(shown) else ""
    legend = Legend(entries=[(rule, colours[rule], "") for rule in rules])
    return [Fold(summary="Timeline", blocks=[legend, Drawing(svg=picture, caption=caption, wide=True)], open=True)]
