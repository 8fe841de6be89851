"""An interaction as controls: what was pulled where in each frame, and of which twin. Played again, it gives the same motion."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from neuspring.core.artifacts import SAFE_NAME, Artifact, Trajectory, Twin, array
from neuspring.core.errors import InputError
from neuspring.extensions.play.simulator import Simulator, Start
from neuspring.report.shown import Found, Run, require_modest
from neuspring.twin.rollout import Diverged

MOST_FRAMES = 20_000
"""Frames of a recording: eleven minutes at 30 frames/s."""
MOST_CONTROL_BYTES = 200_000_000
"""Largest file of a recording, unpacked."""
Row = tuple[np.ndarray, int, np.ndarray, np.ndarray]
"""Hands [C, 3], the grabbed node or -1, its target [3], and which hands hold [C]."""


@dataclass(frozen=True, kw_only=True)
class Controls(Artifact):
    """Hands and grabs that moved a twin in F frames after a start."""

    kind: ClassVar[str] = "recording"
    hands: np.ndarray = array("F,C,3", np.float32, "m", "where each controller is at the end of each frame")
    grabbed: np.ndarray = array("F", np.int32, "1", "the node that is pulled in each frame; -1: none")
    target: np.ndarray = array("F,3", np.float32, "m", "where it is pulled to at the end of each frame")
    holds: np.ndarray = array("F,C", np.bool_, "1", "which controllers hold at the end of each frame; empty: all", omitted=True)
    start: Start = field(default_factory=Start)
    start_frame: int = 0
    """The frame of the recording that it began at."""
    scenario: str
    method: str
    seed: str
    twin_digest: str
    """SHA-256 of the twin's file."""
    motion_digest: str = ""
    """SHA-256 of the positions that were seen [F + 1, N, 3], float32; empty: unknown."""

    def check(self) -> None:
        for name in ("scenario", "method", "seed"):
            if not SAFE_NAME.fullmatch(str(getattr(self, name))):
                raise InputError(f"controls.{name}", f"a name must match {SAFE_NAME.pattern}", repr(getattr(self, name))[:100])
        if not 1 <= len(self.grabbed) <= MOST_FRAMES:
            raise InputError("controls", f"1 to {MOST_FRAMES} frames are required", len(self.grabbed))

    @property
    def name(self) -> str:
        """method/seed of the run that was pulled."""
        return f"{self.method}/{self.seed}"

    def row(self, frame: int) -> tuple[np.ndarray, int, np.ndarray, np.ndarray | None]:
        """Arguments of `Simulator.step` for a frame, the first one being 0."""
        return self.hands[frame], int(self.grabbed[frame]), self.target[frame], self.holds[frame] if self.holds.size else None

    def require_fit(self, twin: Twin) -> None:
        """Raise InputError for a twin that these controls cannot move."""
        controllers, nodes, start = len(twin.topology.controllers), len(twin.topology.nodes), self.start
        counts = {
            "hands": (self.hands.shape[1], "controllers", controllers),
            "start.hands": (len(start.hands) or controllers, "controllers", controllers),
            "start.holds": (len(start.holds) or controllers, "controllers", controllers),
            "start.grip_rows": (start.grip_rows.shape[1] or controllers, "controllers", controllers),
            "start.positions": (len(start.positions) or nodes, "nodes", nodes),
            "start.velocity": (len(start.velocity) or nodes, "nodes", nodes),
            "start.grip_nodes": (start.grip_nodes.shape[1] or nodes, "nodes", nodes),
        }
        for name, (found, what, wanted) in counts.items():
            if found != wanted:
                raise InputError(f"controls.{name}", f"the twin has {wanted} {what}", found, "Use its own scenario.")
        if self.grabbed.min() < -1 or self.grabbed.max() >= nodes:
            raise InputError("controls.grabbed", f"nodes must lie in [-1, {nodes})", [self.grabbed.min(), self.grabbed.max()])


class ControlRecorder:
    """Controls and nodes of each frame since the start, up to MOST_FRAMES. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rows: list[Row] | None = []
        self._seen: list[np.ndarray] = []

    def begin(self, x: np.ndarray) -> None:
        """Forget what was recorded; the nodes are at x [N, 3], m."""
        with self._lock:
            self._rows, self._seen = [], [x.copy()]

    def add(self, row: Row, x: np.ndarray) -> bool:
        """Add a frame. Returns whether the recording has just become too long: all of it goes, as a part has no start."""
        with self._lock:
            if self._rows is None:
                return False
            self._rows.append(row)
            self._seen.append(x.copy())
            if len(self._rows) <= MOST_FRAMES:
                return False
            self._rows, self._seen = None, []
            return True

    def motion_digest(self) -> str:
        """The digest of the motion so far."""
        with self._lock:
            return digest_motion(np.stack(self._seen))

    def controls(self, start: Start, frame: int, **names: str) -> Controls:
        """The recorded controls. Raises InputError where there are none, or too many."""
        with self._lock:
            rows, seen = list(self._rows or ()), list(self._seen)
        if not rows:
            raise InputError("recording", "at least one frame is required", 0, "Reset, and pull again.")
        hands, grabbed, target, holds = (np.stack([np.asarray(row[column]) for row in rows]) for column in range(4))
        return Controls(
            hands=hands,
            grabbed=grabbed.astype(np.int32),
            target=target,
            holds=np.zeros((0, 0), bool) if holds.all() else holds,
            start=start,
            start_frame=frame,
            motion_digest=digest_motion(np.stack(seen)),
            **names,
        )


def load_controls(path: Path) -> Controls:
    """Read a recording. Raises InputError for a damaged, foreign or oversized file."""
    require_modest(path, MOST_CONTROL_BYTES)
    return Controls.load(path)


def replay(twin: Twin, controls: Controls) -> Trajectory:
    """The motion of a twin under controls. One that leaves the scene keeps the frames before. Raises InputError."""
    controls.require_fit(twin)
    simulator = Simulator(twin, start=controls.start)
    positions, diverged, reason = [simulator.positions.copy()], None, ""
    try:
        for frame in range(len(controls.grabbed)):
            positions.append(simulator.step(*controls.row(frame)))
    except Diverged as end:
        diverged, reason = end.frame, end.reason
    return Trajectory(positions=np.stack(positions), frame_count=1 + len(controls.grabbed), diverged_frame=diverged, reason=reason)


def digest_motion(positions: np.ndarray) -> str:
    """SHA-256 of positions [F, N, 3] as float32."""
    return hashlib.sha256(np.ascontiguousarray(positions, np.float32).tobytes()).hexdigest()


@dataclass(frozen=True)
class Difference:
    """Distance between two twins under the same controls, node by node."""

    frames: int
    """Frames that both reached."""
    mean: float
    """Mean distance of nodes over all frames after the first, m."""
    last: float
    """Mean distance of nodes in the last of these frames, m."""
    worst: float
    """Largest distance of a node, m."""
    diverged: str = ""
    """Reason why one of them ended earlier."""


def compare(controls: Controls, own: Twin, other: Twin, seen: Trajectory | None = None) -> Difference:
    """The controls on two twins of one scenario, whose nodes are the same points; `seen`: the motion of `own`, if known.

    Raises InputError where the nodes are others.
    """
    mine, theirs = own.topology.nodes, other.topology.nodes
    if mine.shape != theirs.shape or not np.allclose(mine, theirs, atol=1e-5):
        rule = "both twins must have the same nodes in frame 0"
        raise InputError("twins", rule, [len(mine), len(theirs)], "Compare twins of one scenario.")
    first, second = seen or replay(own, controls), replay(other, controls)
    frames = min(len(first.positions), len(second.positions))
    distance = np.linalg.norm(first.positions[1:frames].astype(float) - second.positions[1:frames], axis=2)
    mean, last, worst = (distance.mean(), distance[-1].mean(), distance.max()) if distance.size else (np.nan, np.nan, np.nan)
    return Difference(frames, float(mean), float(last), float(worst), first.reason or second.reason)


def pulled_run(found: Found, controls: Controls, path: Path) -> Run:
    """The run whose twin was pulled, told by its digest. Raises InputError where it is not there."""
    candidates = sorted((run for run in found.runs if "twin" in run.paths), key=lambda run: run.name != controls.name)
    for run in candidates:
        if run.twin_digest == controls.twin_digest:
            return run
    rule = f"its twin ({controls.scenario}/{controls.name}, SHA-256 {controls.twin_digest[:12]}) must be among the runs"
    twins = f"{len(candidates)} other twins of {found.folder.name}"
    raise InputError(path, rule, twins, "Give the results folder that it was recorded in.")


def comparison(found: Found, controls: Controls, own: Run) -> Iterator[str]:
    """A line per twin: how far its nodes are from those of the twin that was pulled, under the same controls."""
    assert own.twin is not None
    yield f"{len(controls.grabbed)} frames recorded with {own.name}; distances of nodes to it, mm"
    yield f"{'run':32} {'mean':>8} {'last':>8} {'worst':>8}"
    seen = replay(own.twin, controls)
    for run in found.runs:
        if run is own or "twin" not in run.paths:
            continue
        try:
            assert run.twin is not None
            result = compare(controls, own.twin, run.twin, seen)
        except InputError as error:
            yield f"{run.name:32} {error}"
            continue
        numbers = " ".join(f"{1e3 * value:8.1f}" for value in (result.mean, result.last, result.worst))
        yield f"{run.name:32} {numbers}  {result.diverged}".rstrip()
