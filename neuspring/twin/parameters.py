"""What a first-order stage trains, and the physical quantities that follow from it.

Every spring has offsets o on a log scale: its own numbers (`springs`), or the neural spring field at its midpoint (`field`;
rest lengths stay free per spring unless `rest_lengths_by` says otherwise). With b(o) = bound tanh(o / bound), or o without a bound:

    stiffness    Y = Y0 exp(b(o_Y)), clamped to the stiffness range     (linear field: Y0 (1 + b(o_Y)))
    dashpot      g = g0 exp(b(o_g))                                     if damping is trained
    rest length  l = l0 exp(r tanh(o_l))                                if rest_length_bound r > 0
                 l = l0 |(x + u)_i - (x + u)_j| / |x_i - x_j|           if rest_shape.handles > 0 (unloaded.py)

Beside them: four contact scalars, and common factors exp(.), without a bound, of stiffness (`global_stiffness`, or a warm start),
drag and dashpots (`damping`). With `controller_factors` the springs of controllers, which are of another material, have their own;
bending springs, where there are any, always do.
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
from neuspring.physics.parameters import LIMITS, Parameters, pack, twin_tensors
from neuspring.twin.field import SpringField, midpoints
from neuspring.twin.unloaded import UnloadedShape

CONTACT_SCALARS = tuple(LIMITS)
DAMPING_FACTORS = ("drag", "dashpot")
"""Fields of the material with a common factor where damping is trained. One that is zero cannot be scaled and has none."""
SPRING_FACTORS = ("stiffness", "dashpot")
"""Those that may have a factor of their own for controllers' springs and for bending springs."""
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
        self.on_controller = torch.arange(count, device=device) >= topology.object_spring_count
        self.is_bending = torch.tensor(topology.is_bending, device=device)
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
        self.factors = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in self._factor_names()})
        self.unloaded = UnloadedShape(topology, settings.rest_shape.handles) if settings.rest_shape.handles else None
        self.homogeneous = False
        """While true, offsets and the unloaded shape are not trained."""
        self.priors = settings.priors[0]
        """Weights (rest_prior, rest_shape.prior) of the penalty."""
        self.to(device)
        self.first = self.copy()
        """The trained values before the first step."""

    def _factor_names(self) -> list[str]:
        """Common factors that are trained: what they scale, `controller_` or `bending_` before it where of those springs."""
        s = self.settings
        names = ["stiffness"] if s.homogeneous_epochs or s.global_stiffness else []
        names += [name for name in DAMPING_FACTORS if s.damping != "fixed" and bool((self.start[name] > 0).any())]
        parts = ["controller"] if s.controller_factors else []
        parts += ["bending"] if bool(self.is_bending.any()) else []
        return names + [f"{part}_{name}" for part in parts for name in names if name in SPRING_FACTORS]

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
        groups.append((self.scalars.values(), s.scalar_learning_rate or rate, 0.0))
        if self.factors:
            groups.append((self.factors.values(), s.factor_learning_rate or s.scalar_learning_rate or rate, 0.0))
        if self.unloaded is not None:
            groups.append((self.unloaded.parameters(), s.rest_shape.learning_rate, 0.0))
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

    def raw(self) -> dict[str, torch.Tensor]:
        """Offsets [S] before bounding, by what they change."""
        raw = dict(zip(self.channels, self.raw_offsets().unbind(dim=1), strict=True))
        if self.rest_offsets is not None:
            raw["rest_lengths"] = self.rest_offsets.detach() if self.homogeneous else self.rest_offsets
        return raw

    def deviation(self, offset: torch.Tensor) -> torch.Tensor:
        """Factor of each spring's stiffness [S], apart from common factors, for offsets [S] before bounding."""
        bound = self.settings.output_bound
        within = bounded(offset, bound)
        if self.kind == "springs" or self.settings.field.scale == "log":
            return within.exp()
        return inward_clamp(1 + within, math.exp(-bound), math.exp(bound)) if bound else 1 + within

    def _common(self, name: str) -> torch.Tensor | float:
        """The common factor of a physical value: one number, or a number per spring."""
        if name not in self.factors:
            return 1.0
        factor: torch.Tensor = self.factors[name].exp()
        for part, members in (("controller", self.on_controller), ("bending", self.is_bending)):
            if f"{part}_{name}" in self.factors:
                factor = torch.where(members, self.factors[f"{part}_{name}"].exp(), factor)
        return factor

    def physical(self) -> dict[str, torch.Tensor]:
        """Every physical parameter, with the keyword names of `physics.parameters.pack`."""
        s, values, raw = self.settings, dict(self.start), self.raw()
        stiffness = self.start["stiffness"] * (self.deviation(raw["stiffness"]) * self._common("stiffness"))
        # The released baseline clamps plainly. Springs of a field move together, so one beyond a limit must be able to return.
        clamp = inward_clamp if self.kind == "field" else torch.clamp
        values["stiffness"] = clamp(stiffness, *s.stiffness_range)
        for name in DAMPING_FACTORS:
            if name in self.factors:
                values[name] = self.start[name] * self._common(name)
        if "dashpot" in raw:
            values["dashpot"] = values["dashpot"] * bounded(raw["dashpot"], s.output_bound).exp()
        if self.unloaded is not None:
            ratio = self.unloaded()
            values["rest_lengths"] = self.start["rest_lengths"] * (ratio.detach() if self.homogeneous else ratio)
        if "rest_lengths" in raw:
            values["rest_lengths"] = values["rest_lengths"] * (s.rest_length_bound * torch.tanh(raw["rest_lengths"])).exp()
        return values | dict(self.scalars.items())

    def pack(self, substep: float) -> Parameters:
        """Packed for the solver, differentiably."""
        return pack(**self.physical(), substep=substep)

    def penalty(self) -> torch.Tensor:
        """The regularizers of a step, in the loss unit: roughness of the planes, changes of rest lengths, each with its weight."""
        s, total = self.settings, torch.zeros(())
        if self.homogeneous:
            return total
        if self.field is not None and s.field.plane_smoothness:
            total = total + s.field.plane_smoothness * self.field.roughness()
        lengths, shape = self.priors
        raw = self.raw() if lengths else {}
        if "rest_lengths" in raw:
            total = total + lengths * (s.rest_length_bound * torch.tanh(raw["rest_lengths"])).square().mean()
        if self.unloaded is not None and shape:
            total = total + shape * (self.unloaded() - 1).square().mean()
        return total

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
            value = np.clip(values[name], *LIMITS.get(name, (-np.inf, np.inf)))
            material[name] = value if value.ndim else float(value)
        topology = twin.topology
        if self.settings.rest_length_bound or self.unloaded is not None:
            topology = replace(topology, rest_lengths=values["rest_lengths"])
        if self.unloaded is not None:
            shape = topology.canonical + self.unloaded.displacement().detach().cpu().numpy()
            topology = replace(topology, rest_shape=shape.astype(np.float32))
        return replace(twin, material=replace(twin.material, **material), topology=topology)
