"""Parameters that a fit trains, and the physical quantities that follow from them.

Every spring has an offset o on a log scale: its own value (`springs`), or the neural spring field at its midpoint (`field`). With
b(o) = bound tanh(o / bound), or o without a bound, its stiffness is

    Y = Y0 exp(b(o)), clamped to the stiffness range and to g times Y0, the search's stiffness.

Dashpots are clamped as well. Both clamps limit the substeps of a twin, because the stiffness and damping matrices grow at most as
much as their fastest growing spring.

A fit also trains four contact scalars and common factors exp(.) of stiffness (`global_stiffness`), drag and dashpots (`damping`).
With `controller_factors`, controller springs have their own factors, because they model another material.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from neuspring import config
from neuspring.core.artifacts import Topology, Twin
from neuspring.physics.parameters import CONTACT_LIMITS, Parameters, pack, twin_tensors
from neuspring.physics.topology import node_spacing
from neuspring.twin.field import TEXEL_SCALE, SpringField, midpoints

CONTACT_SCALARS = tuple(CONTACT_LIMITS)
DAMPING_FACTORS = ("drag", "dashpot")
"""Fields of the material with a common factor if damping is trained. A field that is zero cannot be scaled and has no factor."""
SPRING_FACTORS = ("stiffness", "dashpot")
"""Fields that may have a separate factor for controller springs."""
UNTRAINED = ("contact_distance",)
"""Fields without a gradient: the contact distance only selects pairs."""
LOWEST_STIFFNESS = 1e-3
"""Smallest stiffness at the start, N; lower values are raised to it."""


class _InwardClamp(torch.autograd.Function):
    """Clamp whose gradient passes inside the limits, and at or beyond a limit only if a descent step leads back inside."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, low: float, high: float | torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        limits = [torch.as_tensor(limit, dtype=value.dtype, device=value.device) for limit in (low, high)]
        ctx.save_for_backward(value, *limits)
        return value.clamp(*limits)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:  # type: ignore[override]
        value, low, high = ctx.saved_tensors
        outward = ((value >= high) & (gradient < 0)) | ((value <= low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None


inward_clamp: Callable[..., torch.Tensor] = _InwardClamp.apply
"""Clamp a value to [low, high]; beyond a limit, gradients that lead back inside still pass."""


def bounded(offset: torch.Tensor, bound: float) -> torch.Tensor:
    """Return bound tanh(offset / bound), or the offset itself if the bound is 0."""
    return bound * torch.tanh(offset / bound) if bound else offset


def topology_spacing(topology: Topology) -> float:
    """Distance between neighboring nodes at rest, m (topology.py); for a single node, the median rest length."""
    nodes = topology.canonical[: len(topology.nodes)]
    return node_spacing(nodes) if len(nodes) > 1 else float(np.median(topology.rest_lengths.astype(np.float64)))


def start_values(twin: Twin, device: str) -> dict[str, torch.Tensor]:
    """Physical values of a twin before the fit, with the keyword names of `physics.parameters.pack`."""
    start = twin_tensors(twin, device)
    start["stiffness"] = start["stiffness"].clamp_min(LOWEST_STIFFNESS)
    return start


class TwinParameters(nn.Module):
    """The trained tensors of a twin, as a module. Checkpoints contain `named_parameters`."""

    def __init__(self, twin: Twin, settings: config.Fit, kind: str, device: str, seed: int = 0) -> None:
        super().__init__()
        self.settings, self.kind = settings, kind
        self.start = start_values(twin, device)
        topology = twin.topology
        count = len(topology.springs)
        self.on_controller = torch.arange(count, device=device) >= topology.object_spring_count
        points = midpoints(topology.canonical, topology.springs)
        self.field = SpringField(points, settings.field, 1, seed) if kind == "field" else None
        self.offsets = nn.Parameter(torch.zeros(count, 1)) if kind == "springs" else None
        self.scalars = nn.ParameterDict({name: nn.Parameter(self.start[name].clone()) for name in CONTACT_SCALARS})
        self.factors = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in self._factor_names()})
        self.to(device)
        self.first = self.copy()
        """The trained values before the first step."""
        self.stiffness_growth, self.dashpot_growth = 1e6, 1e3
        """Largest factors relative to the start. A fit that may change its substeps lowers them."""

    def _factor_names(self) -> list[str]:
        """Names of the trained common factors: the scaled field, with the prefix `controller_` for controller springs."""
        s = self.settings
        names = ["stiffness"] if s.global_stiffness else []
        names += [name for name in DAMPING_FACTORS if s.damping != "fixed" and bool((self.start[name] > 0).any())]
        return names + [f"controller_{name}" for name in names if s.controller_factors and name in SPRING_FACTORS]

    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups of the optimizer, each with its learning rate. `base_rate` stays constant."""
        s = self.settings
        rate = s.learning_rate
        groups: list[tuple[Iterable[nn.Parameter], float]] = []
        if self.offsets is not None:
            groups.append(([self.offsets], rate))
        if self.field is not None:
            groups.append((self.field.layers.parameters(), rate))
            if self.field.planes is not None:
                groups.append((self.field.planes.parameters(), s.field.plane_learning_rate or rate))
        groups.append((self.scalars.values(), rate))
        if self.factors:
            groups.append((self.factors.values(), s.factor_learning_rate or rate))
        return [{"params": list(tensors), "lr": rate, "base_rate": rate} for tensors, rate in groups]

    def deviation(self) -> torch.Tensor:
        """Factor of each spring's stiffness [S], without common factors."""
        offsets = self.offsets if self.offsets is not None else self.field()  # type: ignore[misc]
        return bounded(offsets[:, 0], self.settings.output_bound).exp()

    def _common(self, name: str) -> torch.Tensor | float:
        """The common factor of a physical value: a number, or a number per spring."""
        if name not in self.factors:
            return 1.0
        factor: torch.Tensor = self.factors[name].exp()
        if f"controller_{name}" in self.factors:
            factor = torch.where(self.on_controller, self.factors[f"controller_{name}"].exp(), factor)
        return factor

    def physical(self, start: Mapping[str, torch.Tensor] | None = None) -> dict[str, torch.Tensor]:
        """All physical parameters, with the keyword names of `physics.parameters.pack`, from `start` (None: the twin's values)."""
        s, start = self.settings, self.start if start is None else start
        values = dict(start)
        stiffness = start["stiffness"] * (self.deviation() * self._common("stiffness"))
        # Free springs are clamped as in the released code. Springs of a field move together, so they must be able to return.
        clamp = inward_clamp if self.kind == "field" else torch.clamp
        values["stiffness"] = clamp(inward_clamp(stiffness, 0.0, self.stiffness_growth * start["stiffness"]), *s.stiffness_range)
        for name in DAMPING_FACTORS:
            if name in self.factors:
                values[name] = start[name] * self._common(name)
        values["dashpot"] = inward_clamp(values["dashpot"], 0.0, self.dashpot_growth * start["dashpot"])
        return values | dict(self.scalars.items())

    def pack(self, substep: float, start: Mapping[str, torch.Tensor] | None = None) -> Parameters:
        """Pack the physical parameters for the solver, differentiably."""
        return pack(**self.physical(start), substep=substep)

    def copy(self) -> dict[str, np.ndarray]:
        """Copy the trained values to arrays."""
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.named_parameters()}

    def restore(self, values: dict[str, np.ndarray]) -> None:
        """Set the trained values."""
        with torch.no_grad():
            for name, tensor in self.named_parameters():
                tensor.copy_(torch.from_numpy(np.asarray(values[name])))

    def as_twin(self, twin: Twin) -> Twin:
        """Return `twin` with the current values, clamped as in the simulation."""
        with torch.no_grad():
            values = {name: tensor.double().cpu().numpy() for name, tensor in self.physical().items()}
        material: dict[str, Any] = {}
        for name in (f.name for f in fields(twin.material) if f.name not in UNTRAINED):
            value = np.clip(values[name], *CONTACT_LIMITS.get(name, (-np.inf, np.inf)))
            material[name] = value if value.ndim else float(value)
        return replace(twin, material=replace(twin.material, **material))


MOVED_TEXEL = 0.1
"""Fraction of the initial scale of texels by which a texel must change to count as moved."""
NEAR_BOUND = 0.95
"""Fraction of the bound beyond which a spring counts as at its bound."""


def movement(parameters: TwinParameters) -> dict[str, Any]:
    """Compare the current values with those before the first step. Inapplicable entries are omitted.

    - texels_moved: share of texels that changed by more than a tenth of their initial scale
    - at_bound: share of springs whose log deviation is within 5 % of its bound
    - at_stiffness_range: share of springs at or beyond an end of the stiffness range
    - factors: common factors
    """
    s, figures = parameters.settings, dict[str, Any]()
    with torch.no_grad():
        if parameters.field is not None and parameters.field.planes is not None:
            first = torch.from_numpy(parameters.first["field.planes.texels"])
            change = (parameters.field.planes.texels.cpu() - first).abs()
            figures["texels_moved"] = _share(change > MOVED_TEXEL * TEXEL_SCALE)
        if s.output_bound:
            deviation = parameters.deviation().log()
            figures["at_bound"] = _share(deviation.abs() >= NEAR_BOUND * s.output_bound)
        physical = parameters.physical()
        low, high = s.stiffness_range
        stiffness = physical["stiffness"]
        figures["at_stiffness_range"] = _share((stiffness >= high) | (stiffness <= low))
        if parameters.factors:
            figures["factors"] = {name: float(value.exp()) for name, value in parameters.factors.items()}
    return figures


def _share(selected: torch.Tensor) -> float:
    return float(selected.double().mean())
