"""The option `--take`: hypotheses of `neuspring.checks.rig` on what data of cameras mean, applied to what is read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from neuspring.checks.rig import MEANINGS, Hypothesis
from neuspring.core.errors import InputError
from neuspring.data.camera import Lens

ORDER_TAKEN = "order="


@dataclass(frozen=True)
class Takes:
    """Hypotheses by camera, in their order, and the camera whose pose each one has."""

    of: Mapping[str, tuple[Hypothesis, ...]]
    order: Mapping[str, str]
    given: Sequence[str] = ()
    """The options."""

    @classmethod
    def read(cls, given: Sequence[str], names: Sequence[str]) -> Takes:
        """From options such as `distance`, `inverse+opengl:0,2`, `order=2,1,0`. Raises InputError."""
        of: dict[str, tuple[Hypothesis, ...]] = dict.fromkeys(names, ())
        order = dict(zip(names, names, strict=True))
        for text in given:
            what, _, listed = text.partition(":")
            ordered = text.startswith(ORDER_TAKEN)
            meant = text.removeprefix(ORDER_TAKEN).split(",") if ordered else listed.split(",") if listed else list(names)
            if set(meant) - set(names) or (ordered and sorted(meant) != sorted(names)):
                raise InputError("--take", f"cameras {' '.join(names)} are there", text)
            if ordered:
                order = dict(zip(names, meant, strict=True))
            elif what in MEANINGS:
                of |= {name: (*of[name], MEANINGS[what]) for name in meant}
            else:
                rule = f"one of {' '.join(MEANINGS)} is required, with :CAMERA,... for some alone, or {ORDER_TAKEN}CAMERA,..."
                raise InputError("--take", rule, text)
        return cls(of, order, given)

    def with_more(self, option: str) -> str:
        """An option `--take ...` that holds what is taken already, and one that is found in what came of it."""
        orders = [text for text in option.split()[1:] if text.startswith(ORDER_TAKEN)]
        new = [text for text in option.split()[1:] if text not in orders]
        names = [*self.order]
        for text in orders:
            names = [self.order[name] for name in text.removeprefix(ORDER_TAKEN).split(",")]
        kept = [text for text in self.given if not text.startswith(ORDER_TAKEN)]
        final = names if orders else [*self.order.values()]
        return " ".join(["--take", *kept, *new, *([ORDER_TAKEN + ",".join(final)] if final != [*self.order] else [])])

    def lens(self, name: str, lens: Lens, size: tuple[int, int]) -> Lens:
        """The lens that is meant, of images of `size` (width, height). Raises InputError where it cannot be."""
        for one in self.of[name]:
            lens = replace(lens, model=one.model or lens.model)
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
