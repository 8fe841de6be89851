"""What a fit moved, and what held it: figures that tell whether training did anything."""

from __future__ import annotations

from typing import Any

import torch

from neuspring.twin.parameters import TwinParameters

MOVED = 0.1
"""A texel has moved if it changed by more than this fraction of the texels' scale at the start."""
NEAR = 0.95
"""A spring is at its bound beyond this fraction of it."""


def watched(parameters: TwinParameters) -> torch.Tensor:
    """The values whose gradients are compared with Adam's epsilon: offsets of springs, texels, or the field's first layer."""
    if parameters.offsets is not None:
        return parameters.offsets
    field = parameters.field
    assert field is not None
    return field.planes.texels if field.planes is not None else next(iter(field.layers[0].parameters()))


def median_gradient(tensor: torch.Tensor) -> float:
    """Median |gradient| of a tensor; 0 if it has none."""
    return 0.0 if tensor.grad is None else float(tensor.grad.abs().median())


def movement(parameters: TwinParameters) -> dict[str, Any]:
    """Figures of the present values against those before the first step; those that do not apply are left out.

    texels_moved: share of texels that moved by more than a tenth of their scale at the start. at_bound: share of springs whose
    stiffness lies within 5 % of the bound of its deviation (logarithm). at_stiffness_range: share at or beyond an end of the
    stiffness range. factors: common factors. rest_strain: root mean square relative change of rest lengths.
    """
    s, figures = parameters.settings, dict[str, Any]()
    with torch.no_grad():
        if parameters.field is not None and parameters.field.planes is not None:
            first = torch.from_numpy(parameters.first["field.planes.texels"])
            change = (parameters.field.planes.texels.cpu() - first).abs()
            figures["texels_moved"] = _share(change > MOVED * s.field.texel_scale)
        if s.output_bound:
            deviation = parameters.deviation(parameters.raw()["stiffness"]).log()
            figures["at_bound"] = _share(deviation.abs() >= NEAR * s.output_bound)
        physical = parameters.physical()
        low, high = s.stiffness_range
        stiffness = physical["stiffness"]
        figures["at_stiffness_range"] = _share((stiffness >= high) | (stiffness <= low))
        if parameters.factors:
            figures["factors"] = {name: float(value.exp()) for name, value in parameters.factors.items()}
        if s.rest_length_bound or parameters.unloaded is not None:
            strain = physical["rest_lengths"] / parameters.start["rest_lengths"] - 1
            figures["rest_strain"] = float(strain.square().mean().sqrt())
    return figures


def _share(which: torch.Tensor) -> float:
    return float(which.double().mean())
