"""Meanings of the data of cameras by `--take`: hypotheses of `neuspring.checks.rig`, applied to what is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from neuspring.checks.rig import HYPOTHESES, Hypothesis
from neuspring.core.errors import InputError
from neuspring.data.camera import Lens

ORDERS = "order="


@dataclass(frozen=True)
class Takes:
    """Hypotheses by camera, in their order, and the camera whose pose each one has."""

    of: Mapping[str, tuple[Hypothesis, ...]]
    order: Mapping[str, str]

    @classmethod
    def read(cls, given: Sequence[str], names: Sequence[str]) -> Takes:
        """Read from options such as `distance`, `inverse+opengl:0,2`, `order=2,1,0`. Raises InputError."""
        of: dict[str, tuple[Hypothesis, ...]] = dict.fromkeys(names, ())
        order = dict(zip(names, names, strict=True))
        for text in given:
            what, _, listed = text.partition(":")
            meant = (
                text.removeprefix(ORDERS).split(",") if text.startswith(ORDERS) else listed.split(",") if listed else list(names)
            )
            if set(meant) - set(names) or (text.startswith(ORDERS) and sorted(meant) != sorted(names)):
                raise InputError("--take", f"cameras {' '.join(names)} are there", text)
            if text.startswith(ORDERS):
                order = dict(zip(names, meant, strict=True))
            elif what in HYPOTHESES:
                of |= {name: (*of[name], HYPOTHESES[what]) for name in meant}
            else:
                rule = f"one of {' '.join(HYPOTHESES)} is required, with :CAMERA,... for some alone, or {ORDERS}CAMERA,..."
                raise InputError("--take", rule, text)
        return cls(of, order)

    def lens(self, name: str, lens: Lens, size: tuple[int, int]) -> Lens:
        """The lens that is meant, of images of `size` (width, height). Raises InputError where it cannot be."""
        for one in self.of[name]:
            if one.lens is not None:
                matrix = one.lens(lens.matrix, size)
                if lens.size is not None and one.name == "lens_resized":
                    matrix = np.diag([*np.divide(size, lens.size), 1.0]) @ lens.matrix
                if matrix is None:
                    raise InputError("--take", f"{one.name} must fit camera {name}", f"images of {size[0]} x {size[1]}")
                lens = replace(lens, matrix=matrix, size=size)
        return lens

    def depth(self, name: str, depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """The depth [H, W] that is meant, of the same type."""
        for one in self.of[name]:
            if one.depth is not None:
                meant = one.depth(depth.astype(float), intrinsics)
                depth = (np.round(meant) if depth.dtype.kind in "ui" else meant).astype(depth.dtype)
        return depth

    def poses(self, poses: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The poses that are meant, camera to world [4, 4]."""
        found = {}
        for name, other in self.order.items():
            pose = poses[other]
            for one in self.of[name]:
                pose = pose if one.pose is None else one.pose(pose)
            found[name] = pose
        return found
