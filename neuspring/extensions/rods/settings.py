"""Settings of rods and of recordings of cables."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from neuspring.core.errors import InputError
from neuspring.core.section import Count, Name, Positive, SettingsSection
from neuspring.core.text import listed


@dataclass(frozen=True, kw_only=True)
class RodSettings(SettingsSection):
    """A long thin body as a rod (rods/made.py)."""

    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0; with `lay_out` the unloaded one that the recording knows."""
    lay_out: Annotated[int, Field(ge=4)] | None = None
    """Number of vertices that are laid evenly along the unloaded shape of a line of which few places are observed. They begin at a
    hand, which clamps them with its pose, and in frame 0 they rest under gravity. null: the observed places are the vertices."""


@dataclass(frozen=True, kw_only=True)
class RodFit(SettingsSection):
    """Levenberg-Marquardt on whole recordings (rods/fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc: one value each; a smooth field, cubic between `knots`; free at each joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc: as at the start; one of all; a smooth field; free at each joint."""
    slip: Annotated[int, Field(ge=0)] = 0
    """Branches that slip in bending and twist, friction inside the rod, which are fitted; 0: none."""
    knots: Annotated[int, Field(ge=4)] = 5
    """Knots of a smooth field along the arc."""
    horizons: tuple[Annotated[int, Field(ge=0)], ...] = (60, 150, 0)
    """Training frames that count, one stage of the fit after the other; 0: all. The search has the first."""
    every: Count = 4
    """Stride of the frames that count."""


@dataclass(frozen=True, kw_only=True)
class Mocap(SettingsSection):
    """Motion capture of cables: end markers control, inner markers are observed, the body is sampled as rings."""

    unit: Positive = 1.0
    """m per count of a recording."""
    rate: Positive = 100.0
    """Samples per second of a recording."""
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "+z"
    """Up in a recording. It is turned so that +z is up; x stays x, but for +x and -x."""
    stride: Count = 2
    """Stride of samples of the record."""
    start: Annotated[int, Field(ge=0)] = 0
    """Samples left out at the beginning of the record. With at least one, the velocity in frame 0 is known from the sample before
    it (`simulation.initial_velocity: before`)."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of frames that are kept, the first ones, counted after the stride; shorter recordings are refused. null keeps all."""
    train_fraction: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Part of the frames that are for training, the first ones. 1: all, where future frames are those of other recordings."""
    rings: Annotated[int, Field(ge=2)] = 40
    """Number of rings, whatever their spacing, so that a twin can move to another recording of the cable."""


@dataclass(frozen=True, kw_only=True)
class Posed(SettingsSection):
    """A table with a row per sample: the pose of a hand that holds a long thin body, and markers on it. Meters, seconds, z up."""

    position: tuple[str, str, str] = ("x", "y", "z")
    """Columns of the hand's position."""
    rotation: tuple[str, ...] = ("qx", "qy", "qz", "qw")
    """Columns of its rotation to the world: a quaternion, scalar last, or the three angles that `angles` names."""
    angles: Literal["", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = ""
    """Order of angles, rad, about the axes of the hand as it turns: R = Rz Ry Rx is ZYX. Empty: a quaternion."""
    markers: tuple[tuple[str, str, str], ...] = ()
    """Columns of each marker's position, in their order from the hand on. A marker without numbers is not seen in this sample."""
    unloaded: tuple[tuple[float, float, float], ...] = ()
    """Place of each marker in the frame of the hand if nothing loads the body, which then runs straight from one to the next."""
    clamp: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the clamp on the body's line, in the frame of the hand."""
    radius: Positive = 0.01
    """Radius of the body."""
    stride: Count = 1
    """Stride of samples of the table."""


@dataclass(frozen=True, kw_only=True)
class Deform(SettingsSection):
    """DEFORM's benchmark. For each cable: a pool of training recordings, whose twins go to all evaluation recordings."""

    cables: tuple[Name, ...] = ()
    """Folders of `data_root`, each with recordings `train/NUMBER.pkl` and `eval/NUMBER.pkl`. They are added to `scenarios`, `pools`
    and `transfers`."""
    clips: Annotated[int, Field(ge=2)] = 8
    """Training recordings per cable, equally spaced in the order of their numbers. The first of them names the pool's scenario."""

    def expand(self, config: Any) -> Any:
        """The configuration with the scenarios, pools and transfers of the cables. Raises InputError where files lack."""
        if self.cables and config.data_root is None:
            raise InputError(
                "configuration, deform", "DEFORM's data need data_root", "null", "Give it: --config data_root=/path/to/data."
            )
        pools, transfers, scenarios = dict(config.pools or {}), dict(config.transfers or {}), [*config.scenarios]
        for cable in self.cables:
            folder = Path(config.data_root or ".") / cable
            numbers = {part: sorted(int(file.stem) for file in folder.glob(f"{part}/[0-9]*.pkl")) for part in ("train", "eval")}
            train, judged = ([f"{cable}_{part}_{number}" for number in found] for part, found in numbers.items())
            if len(train) < self.clips or not judged:
                rule = f"at least {self.clips} recordings train/NUMBER.pkl (deform.clips) and one eval/NUMBER.pkl are required"
                there = listed(sorted({path.parent.parent.name for path in folder.parent.glob("*/eval/*.pkl")})) or "none"
                raise InputError(
                    folder, rule, f"{len(train)} and {len(judged)}", f"Correct data_root, deform.cables (there: {there}) or clips."
                )
            picked = [train[i * (len(train) - 1) // (self.clips - 1)] for i in range(self.clips)]
            pools[cable], transfers[picked[0]] = tuple(picked), tuple(judged)
            scenarios += [picked[0]] if picked[0] not in scenarios else []
        return dataclasses.replace(config, scenarios=tuple(scenarios), pools=pools or None, transfers=transfers or None)
