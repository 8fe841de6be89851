"""Parameters that a first-order stage trains, and the physical quantities that follow from it.

Every spring has an offset o on a log scale: its own number (`springs`), or the neural spring field at its midpoint (`field`).
With b(o) = bound tanh(o / bound), or o without a bound, its stiffness is

    Y = Y0 exp(b(o)), clamped to the stiffness range, and to g times its value in the search.

Dashpots are clamped as well. Both bounds limit the substeps that a twin needs: its matrices of stiffness and damping grow at most
as their fastest growing spring.

Beside them: four contact scalars, and common factors exp(.) of stiffness (`global_stiffness`), drag and
dashpots (`damping`). With `controller_factors` the springs of controllers, which are of another material, have their own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
"""Fields of the material with a common factor where damping is trained. One that is zero cannot be scaled and has none."""
SPRING_FACTORS = ("stiffness", "dashpot")
"""Those that may have a factor of their own for controllers' springs."""
UNTRAINED = ("contact_distance",)
"""It only selects pairs, so it has no gradient."""
LOWEST_STIFFNESS = 1e-3
"""Stiffness below this is raised to it before taking the logarithm, N."""


class _InwardClamp(torch.autograd.Function):
    """Clamp whose gradient passes inside the limits, and at or beyond them if a descent step would lead back inside."""

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


def inward_clamp(value: torch.Tensor, low: float, high: float | torch.Tensor) -> torch.Tensor:
    """`value` clamped to [low, high]; a value beyond a limit still feels gradients that pull it back."""
    result: torch.Tensor = _InwardClamp.apply(value, low, high)  # type: ignore[no-untyped-call]
    return result


def bounded(offset: torch.Tensor, bound: float) -> torch.Tensor:
    """bound tanh(offset / bound); the offset itself if the bound is 0."""
    return bound * torch.tanh(offset / bound) if bound else offset


def topology_spacing(topology: Topology) -> float:
    """Distance between neighboring nodes in the rest shape, m (topology.py); of one node alone, the median rest length."""
    nodes = topology.canonical[: len(topology.nodes)]
    return node_spacing(nodes) if len(nodes) > 1 else float(np.median(topology.rest_lengths.astype(np.float64)))


def start_values(twin: Twin, device: str) -> dict[str, torch.Tensor]:
    """Physical values of a twin before the fit, by the keyword names of `physics.parameters.pack`."""
    start = twin_tensors(twin, device)
    start["stiffness"] = start["stiffness"].clamp_min(LOWEST_STIFFNESS)
    return start


class TwinParameters(nn.Module):
    """The trained tensors of a twin, as a module: `named_parameters` is the checkpoint's content."""

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
        """Largest factors over the start; no fit reaches these."""

    def _factor_names(self) -> list[str]:
        """Common factors that are trained: what they scale, `controller_` before it where of those springs."""
        s = self.settings
        names = ["stiffness"] if s.global_stiffness else []
        names += [name for name in DAMPING_FACTORS if s.damping != "fixed" and bool((self.start[name] > 0).any())]
        return names + [f"controller_{name}" for name in names if s.controller_factors and name in SPRING_FACTORS]

    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for the optimizer, each with its learning rate (`base_rate` is not changed later)."""
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
        return [{"params": list(each), "lr": rate, "base_rate": rate} for each, rate in groups]

    def deviation(self) -> torch.Tensor:
        """Factor of each spring's stiffness [S], apart from common factors."""
        offsets = self.offsets if self.offsets is not None else self.field()  # type: ignore[misc]
        return bounded(offsets[:, 0], self.settings.output_bound).exp()

    def _common(self, name: str) -> torch.Tensor | float:
        """The common factor of a physical value: one number, or a number per spring."""
        if name not in self.factors:
            return 1.0
        factor: torch.Tensor = self.factors[name].exp()
        if f"controller_{name}" in self.factors:
            factor = torch.where(self.on_controller, self.factors[f"controller_{name}"].exp(), factor)
        return factor

    def physical(self, start: Mapping[str, torch.Tensor] | None = None) -> dict[str, torch.Tensor]:
        """Every physical parameter, with the keyword names of `physics.parameters.pack`, from `start` (none: the twin's)."""
        s, start = self.settings, self.start if start is None else start
        values = dict(start)
        stiffness = start["stiffness"] * (self.deviation() * self._common("stiffness"))
        # The released baseline clamps plainly. Springs of a field move together, so one beyond a limit must be able to return.
        clamp = inward_clamp if self.kind == "field" else torch.clamp
        values["stiffness"] = clamp(inward_clamp(stiffness, 0.0, self.stiffness_growth * start["stiffness"]), *s.stiffness_range)
        for name in DAMPING_FACTORS:
            if name in self.factors:
                values[name] = start[name] * self._common(name)
        values["dashpot"] = inward_clamp(values["dashpot"], 0.0, self.dashpot_growth * start["dashpot"])
        return values | dict(self.scalars.items())

    def pack(self, substep: float, start: Mapping[str, torch.Tensor] | None = None) -> Parameters:
        """Packed for the solver, differentiably."""
        return pack(**self.physical(start), substep=substep)

    def copy(self) -> dict[str, np.ndarray]:
        """The trained values as arrays."""
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.named_parameters()}

    def restore(self, values: dict[str, np.ndarray]) -> None:
        """Set the trained values."""
        with torch.no_grad():
            for name, tensor in self.named_parameters():
                tensor.copy_(torch.from_numpy(np.asarray(values[name])))

    def as_twin(self, twin: Twin) -> Twin:
        """`twin` with the current values, clamped as in the simulation."""
        with torch.no_grad():
            values = {name: tensor.double().cpu().numpy() for name, tensor in self.physical().items()}
        material: dict[str, Any] = {}
        for name in (f.name for f in fields(twin.material) if f.name not in UNTRAINED):
            value = np.clip(values[name], *CONTACT_LIMITS.get(name, (-np.inf, np.inf)))
            material[name] = value if value.ndim else float(value)
        return replace(twin, material=replace(twin.material, **material))


MOVED_TEXEL = 0.1
"""A texel has moved if it changed by more than this fraction of the texels' scale at the start."""
NEAR_BOUND = 0.95
"""A spring is at its bound beyond this fraction of it."""


def movement(parameters: TwinParameters) -> dict[str, Any]:
    """Figures of the present values against those before the first step; those that do not apply are left out.

    texels_moved: share of texels that moved by more than a tenth of their scale at the start. at_bound: share of springs whose
    stiffness lies within 5 % of the bound of its deviation (logarithm). at_stiffness_range: share at or beyond an end of the
    stiffness range. factors: common factors.
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


def _share(which: torch.Tensor) -> float:
    return float(which.double().mean())
