"""Physical parameters of the kernels: how each follows from a material, and whether it has a gradient.

`PARAMETERS` declares each parameter once. Kernel arguments and buffers (arrays.py), gradients and unions of twins (union.py)
follow from it by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from neuspring.core.artifacts import Material, Twin

Values = Mapping[str, torch.Tensor]
"""Fields of `Material` by name, rest_lengths [S], m, and pushes [S]."""
Parameters = dict[str, torch.Tensor]
"""Result of `pack`: a tensor per name of `PARAMETERS`, with a leading axis [B] for several twins."""
CONTACT_LIMITS = {
    f"{kind}_{name}": limits
    for kind in ("ground", "contact")
    for name, limits in {"elasticity": (0.0, 1.0), "friction": (0.0, 2.0)}.items()
}
"""Limits of the contact fields of `Material`. Values are clamped on use, as in the released simulator."""


class KernelParameter(NamedTuple):
    """One argument of the kernels."""

    per: Literal["spring", "node", "twin"]
    """A Vector per spring, a Number per node, or a Number per twin."""
    pack: Callable[[Values, float | torch.Tensor], torch.Tensor]
    """(values of the material, substep in s) -> [S, 3], [N] or []."""
    trained: bool = True
    """True if it has a gradient."""


def _springs(values: Values, substep: float | torch.Tensor) -> torch.Tensor:
    stiffness, inverse = values["stiffness"], 1.0 / values["rest_lengths"]
    pushes = values.get("pushes")
    if pushes is not None and len(pushes):
        inverse = torch.where(pushes.bool(), -inverse, inverse)
    return torch.stack([stiffness, inverse, values["dashpot"].expand_as(stiffness)], dim=-1)


def _inverse_mass(values: Values, substep: float | torch.Tensor) -> torch.Tensor:
    mass = values.get("mass")
    return values["drag"].detach().new_ones(1) if mass is None or not len(mass) else 1.0 / mass


def _clamped(name: str) -> Callable[[Values, float | torch.Tensor], torch.Tensor]:
    return lambda values, substep: values[name].clamp(*CONTACT_LIMITS[name])


PARAMETERS = {
    # Stiffness Y [N], 1 / rest length [1/m], dashpot [N s/m]. A spring without stiffness and dashpot is absent. A spring with a
    # negative 1 / rest length only pushes.
    "springs": KernelParameter("spring", _springs),
    # Factor of drag on velocities per substep.
    "decay": KernelParameter("twin", lambda values, substep: torch.exp(-substep * values["drag"])),
    "ground_e": KernelParameter("twin", _clamped("ground_elasticity")),
    "ground_mu": KernelParameter("twin", _clamped("ground_friction")),
    "contact_e": KernelParameter("twin", _clamped("contact_elasticity")),
    "contact_mu": KernelParameter("twin", _clamped("contact_friction")),
    # m. It only selects pairs, so it has no gradient.
    "distance": KernelParameter("twin", lambda values, substep: values["contact_distance"], trained=False),
    # 1/kg; [1] if all nodes have 1 kg. Masses are not trained.
    "inverse_mass": KernelParameter("node", _inverse_mass, trained=False),
}


def pack(*, substep: float | torch.Tensor, **values: torch.Tensor) -> Parameters:
    """Pack physical parameters, differentiably.

    - substep: s
    - values: fields of `Material`, rest_lengths [S], m, and pushes [S] if some springs only push. Fields with a default may be
      missing. dashpot may be one number for all springs
    """
    return {name: parameter.pack(values, substep) for name, parameter in PARAMETERS.items()}


def packed(twin: Twin, device: str = "cpu", dtype: torch.dtype = torch.float32) -> Parameters:
    """Pack the parameters of a twin."""
    return pack(**twin_tensors(twin, device, dtype), substep=twin.simulation.substep)


def twin_tensors(twin: Twin, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """The physical parameters of a twin as tensors, with the keyword names of `pack`."""
    values = {f.name: getattr(twin.material, f.name) for f in fields(twin.material)}
    values |= {"rest_lengths": twin.topology.rest_lengths, "pushes": twin.topology.pushes}
    return {name: torch.tensor(value, dtype=dtype, device=device) for name, value in values.items()}


def homogeneous(values: dict[str, float], springs: int) -> Material:
    """A homogeneous material. `values` contains a number for every field of `Material` without a default."""
    every = {f.name: f for f in fields(Material) if f.name in values or (f.default is MISSING and f.default_factory is MISSING)}
    numbers: dict[str, Any] = {name: values[name] for name in every}
    arrays = {name: np.full(springs, values[name]) for name, f in every.items() if "shape" in f.metadata}
    return Material(**(numbers | arrays))
