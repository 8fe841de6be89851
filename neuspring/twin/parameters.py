"""What a first-order stage trains, and the physical quantities that follow from it.

Every spring has offsets o on a log scale: its own numbers (`springs`), or the neural spring field at its midpoint (`field`;
rest lengths stay free per spring unless `rest_lengths_by` says otherwise). With b(o) = bound tanh(o / bound), or o without a bound:

    stiffness    Y = Y0 exp(b(o_Y)), clamped to the stiffness range     (linear field: Y0 (1 + b(o_Y)))
    dashpot      g = g0 exp(b(o_g))                                     if damping is trained
    rest length  l = l0 exp(r tanh(o_l))                                if rest_length_bound r > 0

Beside them: four contact scalars, drag = drag0 exp(.), quadratic drag likewise where there is some, and the homogeneous factors of
a warm start.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from neuspring import config
from neuspring.config import Kind
from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.physics import contact
from neuspring.physics.autograd import pack, twin_tensors
from neuspring.physics.solver import Parameters
from neuspring.twin.field import SpringField, midpoints

CONTACT_SCALARS = ("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction")
UNTRAINED = ("contact_distance",)
"""It only selects pairs, so it has no gradient."""
LOWEST_STIFFNESS = 1e-3
"""Stiffness below this is raised to it before taking the logarithm, N."""


class _InwardClamp(torch.autograd.Function):
    """Clamp whose gradient passes inside the limits, and at or beyond them if a descent step would lead back inside."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, low: float, high: float) -> torch.Tensor:  # type: ignore[override]
        ctx.save_for_backward(value)
        ctx.limits = (low, high)
        return value.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:  # type: ignore[override]
        (value,), (low, high) = ctx.saved_tensors, ctx.limits
        outward = ((value >= high) & (gradient < 0)) | ((value <= low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None


def inward_clamp(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """`value` clamped to [low, high]; a value beyond a limit still feels gradients that pull it back."""
    result: torch.Tensor = _InwardClamp.apply(value, low, high)  # type: ignore[no-untyped-call]
    return result


def bounded(offset: torch.Tensor, bound: float) -> torch.Tensor:
    """bound tanh(offset / bound); the offset itself if the bound is 0."""
    return bound * torch.tanh(offset / bound) if bound else offset


class TwinParameters(nn.Module):
    """The trained tensors of a twin, as a module: `named_parameters` is the checkpoint's content."""

    def __init__(self, twin: Twin, settings: config.Fit, kind: Kind, device: str, seed: int = 0) -> None:
        super().__init__()
        self.settings, self.kind = settings, kind
        self.start = twin_tensors(twin, device)
        self.start["stiffness"] = self.start["stiffness"].clamp_min(LOWEST_STIFFNESS)
        self.channels = ["stiffness"]
        self.channels += ["dashpot"] if settings.damping == "springs" else []
        shared_rest = settings.rest_lengths_by == "field" or kind == "springs"
        self.channels += ["rest_lengths"] if settings.rest_length_bound and shared_rest else []
        topology = twin.topology
        count = len(topology.springs)
        self.covered = count if settings.field.controllers or kind == "springs" else topology.object_spring_count
        self.offsets, self.field, self.rest_offsets = None, None, None
        if settings.rest_length_bound and not shared_rest:
            self.rest_offsets = nn.Parameter(torch.zeros(count))
        if kind == "springs":
            self.offsets = nn.Parameter(torch.zeros(count, len(self.channels)))
        else:
            if not self.covered:
                rule = "a field that leaves out controllers needs springs between object nodes"
                raise InputError("fit.field.controllers", rule, "none", "Let it cover controllers, or widen the search's radii.")
            points = midpoints(topology.canonical, topology.springs)[: self.covered]
            self.field = SpringField(points, settings.field, len(self.channels), seed)
        self.scalars = nn.ParameterDict({name: nn.Parameter(self.start[name].clone()) for name in CONTACT_SCALARS})
        self.factors = nn.ParameterDict()
        names = ["stiffness"] if settings.homogeneous_epochs else []
        damped = ["drag", "dashpot"] + (["drag_quadratic"] if twin.material.drag_quadratic else [])
        for name in names + (damped if settings.damping != "fixed" else []):
            self.factors[name] = nn.Parameter(torch.zeros(()))
        self.homogeneous = False
        """While true, offsets are not trained."""
        self.to(device)

    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups for the optimizer, each with its learning rate (`base_rate` is not changed later) and weight decay."""
        s = self.settings
        rate, decay = s.learning_rate, s.field.weight_decay
        groups: list[tuple[Iterable[nn.Parameter], float, float]] = []
        if self.offsets is not None:
            groups.append(([self.offsets], rate, 0.0))
        if self.field is not None:
            groups.append((self.field.layers.parameters(), rate, decay))
            if self.field.planes is not None:
                groups.append((self.field.planes.parameters(), s.field.plane_learning_rate or rate, decay))
        if self.rest_offsets is not None:
            groups.append(([self.rest_offsets], s.rest_learning_rate or rate, 0.0))
        groups.append(([*self.scalars.values(), *self.factors.values()], s.scalar_learning_rate or rate, 0.0))
        return [{"params": list(each), "lr": rate, "base_rate": rate, "weight_decay": decay} for each, rate, decay in groups]

    def raw_offsets(self) -> torch.Tensor:
        """Offsets [S, channels] before bounding; zero for springs that the field does not cover."""
        if self.offsets is not None:
            raw: torch.Tensor = self.offsets
        else:
            assert self.field is not None
            raw = self.field()
            missing = len(self.start["stiffness"]) - self.covered
            raw = torch.cat([raw, raw.new_zeros(missing, raw.shape[1])]) if missing else raw
        return raw.detach() if self.homogeneous else raw

    def physical(self) -> dict[str, torch.Tensor]:
        """Every physical parameter, with the keyword names of `autograd.pack`."""
        s, values = self.settings, dict(self.start)
        raw = dict(zip(self.channels, self.raw_offsets().unbind(dim=1), strict=True))
        if self.rest_offsets is not None:
            raw["rest_lengths"] = self.rest_offsets.detach() if self.homogeneous else self.rest_offsets
        offset = bounded(raw["stiffness"], s.output_bound)
        linear = self.kind == "field" and s.field.scale == "linear"
        factor = 1 + offset if linear else offset.exp()
        if linear and s.output_bound:
            factor = inward_clamp(factor, math.exp(-s.output_bound), math.exp(s.output_bound))
        if "stiffness" in self.factors:
            factor = factor * self.factors["stiffness"].exp()
        stiffness = self.start["stiffness"] * factor
        # The released baseline clamps plainly. Springs of a field move together, so one beyond a limit must be able to return.
        clamp = inward_clamp if self.kind == "field" else torch.clamp
        values["stiffness"] = clamp(stiffness, *s.stiffness_range)
        if "drag" in self.factors:
            values["drag"] = self.start["drag"] * self.factors["drag"].exp()
            values["dashpot"] = self.start["dashpot"] * self.factors["dashpot"].exp()
        if "drag_quadratic" in self.factors:
            values["drag_quadratic"] = self.start["drag_quadratic"] * self.factors["drag_quadratic"].exp()
        if "dashpot" in raw:
            values["dashpot"] = values["dashpot"] * bounded(raw["dashpot"], s.output_bound).exp()
        if "rest_lengths" in raw:
            values["rest_lengths"] = self.start["rest_lengths"] * (s.rest_length_bound * torch.tanh(raw["rest_lengths"])).exp()
        return values | dict(self.scalars.items())

    def pack(self, substep: float) -> Parameters:
        """Packed for the solver, differentiably."""
        return pack(**self.physical(), substep=substep)

    def penalty(self) -> torch.Tensor:
        """The regularizer of a step: the weighted roughness of the planes."""
        weight = self.settings.field.plane_smoothness
        if self.field is None or not weight or self.homogeneous:
            return torch.zeros(())
        return weight * self.field.roughness()

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
            limits = contact.RANGES.get(name.rpartition("_")[2], (-np.inf, np.inf))
            value = np.clip(values[name], *limits)
            material[name] = value if value.ndim else float(value)
        topology = twin.topology
        if self.settings.rest_length_bound:
            topology = replace(topology, rest_lengths=values["rest_lengths"])
        return replace(twin, material=replace(twin.material, **material), topology=topology)
