"""Gaussian splats: as a PLY file that splat viewers read, and as tensors that can be rendered and trained."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch

from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.splats.rasterize import Rendered, rasterize
from neuspring.splats.view import View

PLY_FORMAT = "format binary_little_endian 1.0"
LONGEST_HEADER = 100_000
NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True, kw_only=True)
class Splats(Artifact):
    """Gaussians in frame 0, stored as PLY (binary, little endian)."""

    kind: ClassVar[str] = "splats"
    means: np.ndarray = array("N,3", np.float32, "m", "centers in the world")
    quaternions: np.ndarray = array("N,4", np.float32, "1", "orientations, w first, any length except zero")
    log_scales: np.ndarray = array("N,A", np.float32, "log m", "standard deviations: A = 1 isotropic, 3 one per axis")
    opacity_logits: np.ndarray = array("N", np.float32, "1", "opacity = 1 / (1 + exp(-.))")
    harmonics: np.ndarray = array("N,K,3", np.float32, "1", "color, see `neuspring.splats.view`; K = 1, 4, 9 or 16")

    def check(self) -> None:
        if self.log_scales.shape[1] not in (1, 3):
            raise InputError("splats.log_scales", "one or three scales are required", self.log_scales.shape[1])
        if self.harmonics.shape[1] not in (1, 4, 9, 16):
            raise InputError("splats.harmonics", "1, 4, 9 or 16 coefficients are required", self.harmonics.shape[1])
        if len(self.means) == 0:
            raise InputError("splats", "at least one splat is required", "none")

    def save(self, path: Path) -> None:
        """Write `path` (.ply) atomically, with the usual properties of splat files in their order.

        The file always has three scales per splat; isotropic splats repeat their scale.
        """
        columns = _columns(3, self.harmonics.shape[1])
        bands = self.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(self.means), -1)
        parts = (self.means, np.zeros_like(self.means), self.harmonics[:, 0], bands, self.opacity_logits[:, None])
        scales = np.broadcast_to(self.log_scales, self.means.shape)
        table = np.concatenate([*parts, scales, self.quaternions], axis=1).astype("<f4")
        properties = [f"property float {name}" for name in columns]
        header = "\n".join(["ply", PLY_FORMAT, f"element vertex {len(table)}", *properties, "end_header", ""])
        write_atomically(Path(path), lambda temporary: temporary.write_bytes(header.encode() + table.tobytes()))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a splat file of this or another trainer. Three scales become one if they are equal in every splat.

        Raises InputError if the file is missing, is truncated or contains no splats.
        """
        table = _read_ply(Path(path))
        names = table.dtype.names or ()
        bands, scales = (sum(name.startswith(prefix) for name in names) for prefix in ("f_rest_", "scale_"))
        if bands % 3:
            raise InputError(path, "f_rest_...: three channels with equally many coefficients are required", bands)
        columns = _columns(scales, 1 + bands // 3)
        missing = [name for name in columns if name not in names and name not in NORMALS]
        if missing:
            raise InputError(path, "must have the properties of Gaussian splats", f"no {', '.join(missing)}")
        values = {name: table[name].astype(np.float32) for name in columns if name not in NORMALS}

        def stacked(prefix: str) -> np.ndarray:
            group = [column for name, column in values.items() if name.startswith(prefix)]
            return np.stack(group, axis=1) if group else np.zeros((len(table), 0), np.float32)

        log_scales = stacked("scale_")
        try:
            return cls(
                means=np.stack([values["x"], values["y"], values["z"]], axis=1),
                quaternions=stacked("rot_"),
                log_scales=log_scales[:, :1] if (log_scales == log_scales[:, :1]).all() else log_scales,
                opacity_logits=values["opacity"],
                harmonics=np.concatenate(
                    [stacked("f_dc_")[:, None], stacked("f_rest_").reshape(len(table), 3, -1).transpose(0, 2, 1)], axis=1
                ),
            )
        except InputError as error:
            raise InputError(path, "must contain usable splats", error) from error


def _columns(scales: int, coefficients: int) -> list[str]:
    """Property names of a splat file in their order; harmonics above the first are stored channel by channel."""
    return [
        *("x", "y", "z", *NORMALS),
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(3 * (coefficients - 1))),
        "opacity",
        *(f"scale_{k}" for k in range(scales)),
        *(f"rot_{k}" for k in range(4)),
    ]


def _read_ply(path: Path) -> np.ndarray:
    """The vertices of a binary PLY as a structured array."""
    rule = "must be a binary little-endian PLY that has only vertices, with float properties of different names"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(path, rule, error.strerror, "First run the stage that writes it.") from error
    head, end, _ = content[:LONGEST_HEADER].partition(b"end_header\n")
    lines = [line for line in head.decode("ascii", errors="replace").splitlines() if not line.startswith("comment ")]
    count = lines[2].removeprefix("element vertex ") if end and lines[:2] == ["ply", PLY_FORMAT] and len(lines) > 3 else ""
    names = [line.removeprefix("property float ") for line in lines[3:]]
    if not count.isdigit() or int(count) == 0 or len(set(names)) < len(names) or any(" " in name for name in names):
        raise InputError(path, rule, lines[:4] or repr(content[:40]))
    layout = np.dtype([(name, "<f4") for name in names])
    if (available := (len(content) - len(head) - len(end)) // layout.itemsize) < int(count):
        received = f"{available}: the file is truncated"
        raise InputError(path, f"the header promises {count} splats", received, "Delete the file, then rerun the same command.")
    return np.frombuffer(content, layout, int(count), offset=len(head) + len(end))


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Splats as tensors on a device, for rendering and training. Shapes as in `Splats`."""

    means: torch.Tensor
    quaternions: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    harmonics: torch.Tensor

    @classmethod
    def of(cls, splats: Splats, device: str = "cpu") -> Gaussians:
        """Tensors of stored splats."""
        return cls(**{field.name: torch.tensor(getattr(splats, field.name), device=device) for field in dataclasses.fields(cls)})

    def stored(self) -> Splats:
        """These splats as an artifact."""
        return Splats(**{name: tensor.detach().cpu().numpy() for name, tensor in vars(self).items()})

    @property
    def opacities(self) -> torch.Tensor:
        """Opacities [N] in 0..1."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> torch.Tensor:
        """Standard deviations [N, 3], m."""
        return torch.exp(self.log_scales).expand(-1, 3)

    def draw(self, view: View, *, degree: int = 3, **options: Any) -> Rendered:
        """Render an image with harmonics up to `degree`. Options are those of `rasterize`: background, limits, backend."""
        degree = min(degree, math.isqrt(self.harmonics.shape[1]) - 1)
        tensors = (self.means, self.quaternions, self.scales, self.opacities, self.harmonics)
        return rasterize(*tensors, view, degree=degree, **options)
