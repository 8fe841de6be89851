"""Rows of the table, from prepared frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from neuspring.core.artifacts import Twin
from results.published.bench.ours import Ours
from results.published.bench.simulators import Frame, Simulator, distances, gradient_difference, take_turns
from results.published.bench.table import Row

KINDS = (("forward", False), ("forward + backward", True))
"""Name of a measurement, and whether it includes the gradient."""


@dataclass(frozen=True)
class Bench:
    """Device, simulators and options of a section."""

    device: str
    ours: Ours
    peer: Simulator | None = None
    quick: bool = False
    notes: list[str] = field(default_factory=list)
    """Notes that are printed below the table."""

    @property
    def on_gpu(self) -> bool:
        """Whether the device is CUDA."""
        return self.device != "cpu"


@dataclass(frozen=True)
class Entry:
    """A row before its measurement."""

    name: str
    twin: Twin
    """The twin, or one of several of the same nodes."""
    frame: Frame
    reference: str = ""
    batch: int = 1
    springs: int = 0
    """Mean number of springs if twins differ; 0: that of `twin`."""

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Number of nodes, springs, substeps and twins."""
        topology = self.twin.topology
        return len(topology.nodes), self.springs or len(topology.springs), self.twin.simulation.substeps, self.batch


def frame_of(simulator: Simulator, twin: Twin, hands: np.ndarray, gradient: bool) -> Frame:
    """A frame of one twin, with or without its gradient."""
    return simulator.forward_backward(twin, hands) if gradient else simulator.forward(twin, hands)


def timed(bench: Bench, section: str, entries: Sequence[Entry]) -> list[Row]:
    """Rows of entries that are measured in turns. Ratios are of time per spring, substep and twin."""
    rounds, seconds = (5, 2.0) if bench.quick else (9, 5.0)
    times = take_turns({entry.name: entry.frame.run for entry in entries}, bench.device, rounds=rounds, seconds=seconds)
    named = {entry.name: entry for entry in entries}
    rows = []
    for entry in entries:
        mine, (nodes, springs, substeps, batch) = times[entry.name], entry.counts
        row = Row(
            section=section, name=entry.name, device=bench.device, median=1e3 * mine.median, least=1e3 * mine.least,
            nodes=nodes, springs=springs, substeps=substeps, batch=batch,
        )  # fmt: skip
        if entry.reference:
            other = named[entry.reference]
            ratio, scale = mine.over(times[other.name]), np.prod(other.counts[1:]) / np.prod(entry.counts[1:])
            row = replace(row, ratio=float(scale * ratio.median), least_ratio=float(scale * ratio.least), reference=other.name)
        rows.append(row)
    return rows


def agree(bench: Bench, entries: Sequence[Entry]) -> None:
    """Add notes on the difference of positions and gradients from those of the reference entries."""
    named = {entry.name: entry for entry in entries}
    for entry in entries:
        if entry.reference:
            frame, other = entry.frame, named[entry.reference].frame
            found = f"positions agree with those of '{entry.reference}' to {distances(frame, other).max():.1e} m"
            if frame.gradient and other.gradient:
                found += f", gradients to {gradient_difference(frame, other):.1e} of their norm"
            bench.notes.append(f"{entry.name}, {bench.device}: {found}")
