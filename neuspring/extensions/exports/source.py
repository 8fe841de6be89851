"""Source of an export: a twin, its predicted motion, its controllers and its splats, from a run's folder or a `twin.npz`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.core.run_folder import RunFolder
from neuspring.splats.draw import prune_by_opacity, skinned_frames
from neuspring.splats.model import Splats
from neuspring.twin.body import body_of, lines_of, with_mass
from neuspring.twin.rollout import initial_velocity

SOURCE_REMEDY = "Give results/<scenario>/<method>/<seed> of a run with a twin, or a twin.npz."
FRAME_RANGE = re.compile(r"\d{1,9}(:\d{1,9}(:[1-9]\d{0,8})?)?")


@dataclass(frozen=True)
class ExportSource:
    """A twin and its motion, with F frames, N nodes and C controllers."""

    name: str
    twin: Twin
    positions: np.ndarray
    """Predicted nodes [F, N, 3], m."""
    hands: np.ndarray
    """Controllers [F, C, 3], m."""
    holds: np.ndarray
    """True where a controller holds the object [F, C]."""
    velocity: np.ndarray
    """Velocity of the nodes in frame 0 [N, 3], m/s."""
    splats: Splats | None = None
    """Splats in the shape of frame 0."""
    made_from: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the source files, by file name."""
    frames: np.ndarray = field(default_factory=lambda: np.zeros(1, np.int64))
    """Frame number of each row of positions, hands and holds [F]."""
    seen: Observations | None = None
    """Observations of the recording."""
    scenario_folder: Path | None = None
    """Results folder of the scenario, if the source has a predicted motion."""
    is_weighed: bool = False
    """True if the user gave the object's mass."""

    @property
    def times(self) -> np.ndarray:
        """Time of each frame since frame 0 [F], s."""
        return self.frames * self.twin.simulation.frame_time

    @property
    def masses(self) -> np.ndarray:
        """Masses of the nodes [N], kg; 0 if other points of the body have the mass."""
        return lines_of(self.twin).masses[: len(self.twin.topology.nodes)]

    @property
    def total_mass(self) -> float:
        """Total mass of the body's points, kg."""
        return float(lines_of(self.twin).masses.sum(dtype=float))

    @property
    def weight(self) -> str:
        """The total mass as text, with the next move if the user did not give the mass."""
        text = f"{self.total_mass:.4g} kg in all"
        if self.is_weighed or len(self.twin.material.mass):
            return text
        remedy = "Only forces per mass affect the motion. To scale masses and forces, give --mass KG, or mass in capture.json."
        return f"{text}, by convention ({body_of(self.twin).convention}). {remedy}"

    def only(self, frames: Sequence[int]) -> ExportSource:
        """The source with only these frames."""
        rows = list(frames)
        changed = {name: getattr(self, name)[rows] for name in ("positions", "hands", "holds", "frames")}
        return replace(self, **changed)

    def moved_splats(self, frames: Sequence[int]) -> Iterator[tuple[int, Splats]]:
        """The splats in these frames, in increasing order, as images show them. Raises InputError without splats.

        The source must have all frames, because the nodes carry splats from each frame to the next.
        """
        if self.splats is None:
            remedy = "Give the folder of a run whose scenario has appearance/<seed>/splats.ply."
            raise InputError(self.name, "splats are required", "none", remedy)
        carried = skinned_frames(prune_by_opacity(self.splats), self.positions[: max(frames) + 1], "cpu")
        return ((frame, gaussians.stored()) for frame, gaussians in enumerate(carried) if frame in frames)


def read_source(path: Path, mass: float | None = None) -> ExportSource:
    """Read a run's folder (results/<scenario>/<method>/<seed>), or a twin.npz, which has only frame 0.

    The twin is scaled to the total `mass`, kg; without it to the mass of the run's capture, if known. Raises InputError for an
    incomplete folder, and for a run that has no twin or failed.
    """
    if mass is not None and not 0 < mass < np.inf:
        raise InputError("--mass", "must be a positive number of kg", mass)
    source = _read(path)
    if mass is None and source.seen is not None:
        mass = source.seen.scenario.mass
    return source if mass is None else replace(source, twin=with_mass(source.twin, mass), is_weighed=True)


def _read(path: Path) -> ExportSource:
    """The source, with the masses of the stored twin."""
    if path.is_file():
        return _at_rest(path.parent.name or "twin", Twin.load(path), {path.name: digest_file(path)})
    if not path.is_dir():
        raise InputError(path, "must be a run's folder or a twin.npz", "no such file or folder", SOURCE_REMEDY)
    run = RunFolder.of(path)
    name, twin = "_".join(run.folder.parts[-3:]), run.twin
    if twin is None:
        failed = next((record.reason for record in run.records.values() if record.status == "failed"), "")
        found = f"a failure: {failed}" if failed else f"a baseline's model ({run.learning[-1]})" if run.learning else "none"
        raise InputError(path, "must be the run of a method that fits a twin", found, SOURCE_REMEDY)
    twin_name, digest = run.stages[run.learning[-1]].record.files["twin"]
    trajectory, observations = run.trajectory, run.observations
    rest = _at_rest(name, twin, {twin_name: digest}, observations)
    if trajectory is None:
        return rest
    if trajectory.diverged_frame is not None:
        raise InputError(
            path,
            "the run must have a motion in all frames",
            f"a rollout that diverged: {trajectory.reason}",
            f"To export the twin without motion, name {run.twin_file}.",
        )
    count = len(trajectory.positions)
    if trajectory.positions.shape[1:] != twin.topology.nodes.shape or count > len(observations.controller_points):
        rule = f"must have the {len(twin.topology.nodes)} nodes of the twin and the frames of the observations"
        raise InputError(path / "trajectory.npz", rule, trajectory.positions.shape, "Delete rollout.json and rerun the workflow.")
    hands, valid = observations.controller_points[:count], observations.controller_valid
    splats = run.file("appearance", "splats")
    return replace(
        rest,
        twin=body_of(twin).for_prediction(twin),
        positions=trajectory.positions,
        hands=hands,
        holds=valid[:count] if valid.size else np.ones(hands.shape[:2], bool),
        velocity=initial_velocity(observations, twin.simulation.initial_velocity),
        splats=None if splats is None else Splats.load(splats),
        made_from=rest.made_from | dict(run.stages["rollout"].record.files.values()),
        frames=np.arange(count),
        scenario_folder=run.scenario_folder,
    )


def chosen_frames(text: str | None, source: ExportSource, default: str) -> list[int]:
    """Frames of FIRST, FIRST:STOP or FIRST:STOP:STEP (STOP is excluded).

    Without `text` they are `default`; if that is empty too, they are all frames.
    """
    count = len(source.positions)
    words = text if text is not None else default or f"0:{count}"
    numbers = [int(word) for word in words.split(":")] if FRAME_RANGE.fullmatch(words) else [0, 0]
    frames = range(*numbers) if len(numbers) > 1 else numbers
    if not frames or frames[-1] >= count:
        raise InputError("--frames", f"must be FIRST, FIRST:STOP or FIRST:STOP:STEP, with frames of 0 to {count - 1}", words)
    return list(frames)


def _at_rest(name: str, twin: Twin, digests: dict[str, str], seen: Observations | None = None) -> ExportSource:
    topology = twin.topology
    return ExportSource(
        name=name,
        twin=twin,
        positions=topology.nodes[None],
        hands=topology.controllers[None],
        holds=np.ones((1, len(topology.controllers)), bool),
        velocity=np.zeros(topology.nodes.shape),
        made_from=digests,
        seen=seen,
    )


def require_start(frames: Sequence[int]) -> None:
    """Raise InputError unless the frames are 0, 1, 2, ...: a simulator needs the controllers of every frame."""
    if list(frames) != list(range(len(frames))):
        rule = "a simulator needs the controllers of all frames from 0 on"
        raise InputError("--frames", rule, f"{frames[0]} to {frames[-1]}, {len(frames)} frames", "Give 0:STOP, or omit it.")
