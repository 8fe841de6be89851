"""The unit of depth and the frame rate: given or found, always said, and refused where the scene would be none on a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuspring.core.errors import InputError

NEAR, FAR = 0.1, 10.0
"""m. Median depths outside this range are no table in a room."""
LIKELY = (0.2, 3.0)
"""m. A guessed unit must bring the median depth into this range."""
KNOWN = {
    0.001: "millimeters",
    0.0001: "tenths of a millimeter",
    0.00025: "quarters of a millimeter",
    0.0002: "1/5000 m",
    1.0: "meters",
}
"""m per count, and where it is used: most cameras, RealSense L515 and D405, L515's default, TUM's data sets, floating point."""
SLOWEST, FASTEST = 1.0, 240.0
"""Frames per second of a camera."""


@dataclass(frozen=True)
class Unit:
    """Meters per count of depth, and how it is known."""

    meters: float
    how: str

    def text(self) -> str:
        """In one line."""
        name = f" ({KNOWN[self.meters]})" if self.meters in KNOWN else ""
        return f"{self.meters:g} m per count{name}, {self.how}"


def find_unit(where: object, depths: Sequence[np.ndarray], given: float | None, known: float | None = None) -> Unit:
    """The unit of depth images [H, W] as stored: the given one, that of the source, or a guess from the type and the scene.

    Whole numbers are guessed to be millimeters, floating point meters or millimeters. Raises InputError where the guess does not
    fit or the scene would be smaller than NEAR or larger than FAR, with the units that would do.
    """
    values = np.concatenate([depth[np.isfinite(depth) & (depth > 0)].astype(float) for depth in depths])
    if not len(values):
        raise InputError(where, "some depth is required", "0 in every pixel of the images that were looked at")
    count, whole = float(np.median(values)), depths[0].dtype.kind in "ui"
    kind = "whole numbers" if whole else "floating point"
    chosen = given if given is not None else known
    if chosen is not None:
        if not (np.isfinite(chosen) and chosen > 0):
            raise InputError("--depth-unit", "meters per count, above 0, are required", chosen)
        median = count * chosen
        if not NEAR < median < FAR:
            rule = f"--depth-unit: the median depth must lie between {NEAR:g} and {FAR:g} m"
            raise InputError(where, rule, f"{chosen:g} m per count, which makes it {median:.4g} m", _advice(count))
        return Unit(chosen, "given" if given is not None else f"as the source says; median depth {median:.2f} m")
    order = [0.001] if whole else [1.0, 0.001]
    fitting = [unit for unit in order if LIKELY[0] <= count * unit <= LIKELY[1]]
    if not fitting:
        rule = f"the unit of depth cannot be guessed: {kind} with a median of {count:.4g}"
        raise InputError(where, rule, remedy=_advice(count) + " Give --depth-unit.")
    return Unit(fitting[0], f"guessed from {kind} with a median of {count:.4g}: median depth {count * fitting[0]:.2f} m")


def find_rate(given: float | None, known: Sequence[float | None], step: int) -> tuple[float, str]:
    """Frames per second of the capture and how they are known: `given` or that of the videos, over every `step`-th frame.

    Raises InputError where there is none, or one that no camera has.
    """
    told = [rate for rate in known if rate is not None]
    if given is None and not told:
        raise InputError("--rate", "the frames per second of the camera are required: folders do not have them", "none")
    if given is None and max(told) > 1.02 * min(told):
        raise InputError("--rate", "all cameras must film at one rate", " and ".join(f"{rate:.3g}" for rate in told))
    rate = given if given is not None else round(told[0], 2)
    if not (np.isfinite(rate) and SLOWEST <= rate <= FASTEST):
        rule = f"frames per second of a camera lie between {SLOWEST:g} and {FASTEST:g}"
        raise InputError("--rate", rule, f"{rate:g}", "Give the rate at which it was filmed, not a time step.")
    how = "given" if given is not None else "as the video says"
    if given is not None and told and abs(told[0] - given) > 0.02 * given:
        how = f"given; the video says {told[0]:.3g}"
    thinned = f", one in {step} of {rate:g}" if step > 1 else ""
    return rate / step, f"{rate / step:g} frames per second, {how}{thinned}"


def _advice(count: float) -> str:
    fitting = [f"{unit:g} ({name})" for unit, name in KNOWN.items() if NEAR < count * unit < FAR]
    if not fitting:
        return "No common unit makes it a scene on a table: is this a raw depth image?"
    return f"Plausible would be {' or '.join(fitting)}."
