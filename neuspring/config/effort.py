"""The setting `effort`: named sets of the sizes that determine how long a benchmark takes."""

from __future__ import annotations

from typing import Any, Literal, get_args

from neuspring.config.extensions import EXTENSION_SETTINGS
from neuspring.config.parse import merge, nested

Effort = Literal["quick", "normal", "paper"]
EFFORTS = get_args(Effort)
EFFORT_SIZES: dict[str, tuple[Any, Any, Any]] = {
    # Key: quick, normal, paper.
    "search.rollouts": (88, 110, 220),
    "search.tied_rollouts": (0, 44, 0),
    "fit.epochs": (20, 40, 200),
    "perception.sample.voxel": (0.006, 0.006, 0.005),
    "perception.sample.nodes": (300, 400, None),
    "images.appearance.iterations": (150, 400, 10_000),
    "images.appearance.opacity_rate": (0.05, 0.025, 0.025),
    "images.appearance.spacing": (2.0, 2.0, 0.0),
    "images.appearance.degree": (0, 0, 3),
    **{f"{path}.{key}": values for path, kind in EXTENSION_SETTINGS.items() for key, values in kind.efforts.items()},
}
"""Key -> its value at each effort. quick: `make demo`. normal: the published synthetic benchmark. paper: sizes of the paper and
the released code, which are also the defaults of all keys except `synthetic.size`."""


def sizes(effort: str) -> dict[str, Any]:
    """The values of an effort, nested as in a configuration file."""
    values: dict[str, Any] = {}
    for path, choices in EFFORT_SIZES.items():
        merge(values, nested(path, choices[EFFORTS.index(effort)]))
    return values
