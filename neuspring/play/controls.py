"""An interaction as controls: what was pulled where in each frame, and of which twin. Played again, it gives the same motion."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from neuspring.core.artifacts import SAFE_NAME, Artifact, Trajectory, Twin, array
from neuspring.core.errors import InputError
from neuspring.play.guard import require_modest
from neuspring.play.simulator import Simulator, Start
from neuspring.twin.rollout import Diverged

MOST_FRAMES = 20_000
"""Frames of a recording: eleven minutes at 30 frames/s."""


@dataclass(frozen=True, kw_only=True)
class Controls(Artifact):
    """What was done to a twin in F frames after a start; start arrays are empty where it is the twin's frame 0, at rest."""

    kind: ClassVar[str] = "controls"
    hands: np.ndarray = array("F,C,3", np.float32, "m", "where each controller is at the end of each frame")
    grabbed: np.ndarray = array("F", np.int32, "1", "the node that is pulled in each frame; -1: none")
    target: np.ndarray = array("F,3", np.float32, "m", "where it is pulled to at the end of each frame")
    holds: np.ndarray = array("F,C", np.bool_, "1", "which controllers hold at the end of each frame; empty: all", omitted=True)
    start_positions: np.ndarray = array("N,3", np.float32, "m", "nodes at the start", omitted=True)
    start_velocity: np.ndarray = array("N,3", np.float32, "m/s", "of the nodes at the start", omitted=True)
    start_hands: np.ndarray = array("C,3", np.float32, "m", "controllers at the start", omitted=True)
    start_holds: np.ndarray = array(
        "C", np.float32, "1", "which controllers hold at the start, as in physics/controllers.py", omitted=True
    )
    grip_rows: np.ndarray = array("G,C,4", np.float32, "m, 1", "controllers when some took hold before the start", omitted=True)
    grip_nodes: np.ndarray = array("G,N,3", np.float32, "m", "the nodes at these moments", omitted=True)
    scenario: str
    method: str
    seed: str
    twin_digest: str
    """SHA-256 of the twin's file."""
    motion_digest: str = ""
    """SHA-256 of the positions that were seen [F + 1, N, 3], float32; empty: unknown."""
    start_frame: int = 0
    """The frame of the recording that it began at."""

    @classmethod
    def of(cls, start: Start, **values: Any) -> Self:
        """Controls from a start."""
        named = {f"start_{field.name}": getattr(start, field.name) for field in fields(Start) if field.name != "grips"}
        values |= {name: value for name, value in named.items() if value is not None}
        if start.grips:
            values |= {name: np.stack([grip[i] for grip in start.grips]) for i, name in enumerate(("grip_rows", "grip_nodes"))}
        return cls(**values)

    @property
    def start(self) -> Start:
        """The state that it began in."""
        named = {name: getattr(self, f"start_{name}") for name in ("positions", "velocity", "hands", "holds")}
        grips = tuple(zip(self.grip_rows, self.grip_nodes, strict=True))
        return Start(**{name: value for name, value in named.items() if value.size}, grips=grips)

    def row(self, frame: int) -> tuple[np.ndarray, int, np.ndarray, np.ndarray | None]:
        """What `Simulator.step` takes for a frame, the first one being 0."""
        return self.hands[frame], int(self.grabbed[frame]), self.target[frame], self.holds[frame] if self.holds.size else None

    def check(self) -> None:
        for name in ("scenario", "method", "seed"):
            if not SAFE_NAME.fullmatch(str(getattr(self, name))):
                raise InputError(f"controls.{name}", f"a name must match {SAFE_NAME.pattern}", repr(getattr(self, name))[:100])
        if not 1 <= len(self.grabbed) <= MOST_FRAMES:
            raise InputError("controls", f"1 to {MOST_FRAMES} frames are required", len(self.grabbed))
        if len(self.grip_rows) != len(self.grip_nodes):
            raise InputError("controls.grip_rows", "one entry per entry of grip_nodes is required", len(self.grip_rows))

    @property
    def name(self) -> str:
        """method/seed of the run that was pulled."""
        return f"{self.method}/{self.seed}"

    def require_fit(self, twin: Twin) -> None:
        """Raise InputError for a twin that these controls cannot move."""
        controllers, nodes = len(twin.topology.controllers), len(twin.topology.nodes)
        if self.hands.shape[1] != controllers:
            raise InputError(
                "controls.hands", f"the twin has {controllers} controllers", self.hands.shape[1], "Use its own scenario."
            )
        for name in ("start_positions", "start_velocity"):
            if len(getattr(self, name)) not in (0, nodes):
                raise InputError(
                    f"controls.{name}", f"the twin has {nodes} nodes", len(getattr(self, name)), "Use its own scenario."
                )
        if self.grip_nodes.size and self.grip_nodes.shape[1] != nodes:
            raise InputError(
                "controls.grip_nodes", f"the twin has {nodes} nodes", self.grip_nodes.shape[1], "Use its own scenario."
            )
        if self.grabbed.min() < -1 or self.grabbed.max() >= nodes:
            raise InputError("controls.grabbed", f"nodes must lie in [-1, {nodes})", [self.grabbed.min(), self.grabbed.max()])


def load_controls(path: Path) -> Controls:
    """Read a recording. Raises InputError for a damaged, foreign or oversized file."""
    require_modest(path, 200_000_000)
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
    """How far two twins are apart under the same controls, node by node."""

    frames: int
    """Frames that both reached."""
    mean: float
    """Mean distance of nodes over all frames after the first, m."""
    last: float
    """Mean distance of nodes in the last of these frames, m."""
    worst: float
    """Largest distance of a node, m."""
    diverged: str = ""
    """Why one of them ended earlier."""


def compare(controls: Controls, own: Twin, other: Twin, seen: Trajectory | None = None) -> Difference:
    """The controls on two twins of one scenario, whose nodes are the same points; `seen`: the motion of `own`, if known.

    Raises InputError where the nodes are others.
    """
    if own.topology.nodes.shape != other.topology.nodes.shape or not np.allclose(
        own.topology.nodes, other.topology.nodes, atol=1e-5
    ):
        rule = "both twins must have the same nodes in frame 0"
        raise InputError("twins", rule, [len(own.topology.nodes), len(other.topology.nodes)], "Compare twins of one scenario.")
    first, second = seen or replay(own, controls), replay(other, controls)
    frames = min(len(first.positions), len(second.positions))
    distance = np.linalg.norm(first.positions[1:frames].astype(float) - second.positions[1:frames], axis=2)
    if not distance.size:
        return Difference(frames, np.nan, np.nan, np.nan, first.reason or second.reason)
    return Difference(
        frames, float(distance.mean()), float(distance[-1].mean()), float(distance.max()), first.reason or second.reason
    )
