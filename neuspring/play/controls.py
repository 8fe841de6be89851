"""An interaction as controls: what was pulled where in each frame, and of which twin. Played again, it gives the same motion."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from neuspring.core.artifacts import SAFE_NAME, Artifact, Trajectory, Twin, array
from neuspring.core.errors import InputError
from neuspring.play.guard import require_modest
from neuspring.play.simulator import Simulator
from neuspring.twin.rollout import Diverged

MOST_FRAMES = 20_000
"""Frames of a recording: eleven minutes at 30 frames/s."""


@dataclass(frozen=True, kw_only=True)
class Controls(Artifact):
    """What was done to a twin in frames 1 to F, from its frame 0 at rest."""

    kind: ClassVar[str] = "controls"
    hands: np.ndarray = array("F,C,3", np.float32, "m", "where each controller is at the end of each frame")
    grabbed: np.ndarray = array("F", np.int32, "1", "the node that is pulled in each frame; -1: none")
    target: np.ndarray = array("F,3", np.float32, "m", "where it is pulled to at the end of each frame")
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

    def require_fit(self, twin: Twin) -> None:
        """Raise InputError for a twin that these controls cannot move."""
        controllers, nodes = len(twin.topology.controllers), len(twin.topology.nodes)
        if self.hands.shape[1] != controllers:
            raise InputError(
                "controls.hands", f"the twin has {controllers} controllers", self.hands.shape[1], "Use its own scenario."
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
    simulator = Simulator(twin)
    positions, diverged, reason = [simulator.positions], None, ""
    try:
        for hands, node, target in zip(controls.hands, controls.grabbed, controls.target, strict=True):
            positions.append(simulator.step(hands, int(node), target))
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


def compare(controls: Controls, own: Twin, other: Twin) -> Difference:
    """The controls on two twins of one scenario, whose nodes are the same points. Raises InputError where they are not."""
    if own.topology.nodes.shape != other.topology.nodes.shape or not np.allclose(
        own.topology.nodes, other.topology.nodes, atol=1e-5
    ):
        rule = "both twins must have the same nodes in frame 0"
        raise InputError("twins", rule, [len(own.topology.nodes), len(other.topology.nodes)], "Compare twins of one scenario.")
    first, second = replay(own, controls), replay(other, controls)
    frames = min(len(first.positions), len(second.positions))
    distance = np.linalg.norm(first.positions[1:frames].astype(float) - second.positions[1:frames], axis=2)
    if not distance.size:
        return Difference(frames, np.nan, np.nan, np.nan, first.reason or second.reason)
    return Difference(
        frames, float(distance.mean()), float(distance[-1].mean()), float(distance.max()), first.reason or second.reason
    )
