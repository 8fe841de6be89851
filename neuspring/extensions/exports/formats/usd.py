"""USD: animated nodes, springs as curves, and splats as Gaussian particle fields with points as proxy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.core.files import write_atomically
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.formats import ply
from neuspring.extensions.exports.source import ExportSource
from neuspring.splats.view import C0
from neuspring.twin.body import lines_of

SUFFIXES = (".usdc", ".usda", ".usd")
ROOT_PRIM = "/Twin"
SPRING_WIDTH, NODE_WIDTH = 0.1, 0.3
"""Widths of springs and nodes, in median rest lengths."""
SPLAT_REACH = float(np.sqrt(2 * np.log(255)))
"""Radius of a rendered splat, in standard deviations: an opaque splat has the coverage 1 / 255 there."""


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write one file, with one time code per frame of the twin."""
    Usd, UsdGeom = needed("pxr.Usd"), needed("pxr.UsdGeom")
    if output.suffix not in SUFFIXES:
        raise InputError("--output", f"must end with {', '.join(SUFFIXES)}", output.name)
    rate = 1 / source.twin.simulation.frame_time
    codes = {frame: round(float(source.times[frame]) * rate, 6) for frame in frames}
    stage = Usd.Stage.CreateInMemory(f"twin{output.suffix}")  # The suffix selects the encoding.
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(min(codes.values()))
    stage.SetEndTimeCode(max(codes.values()))
    root = UsdGeom.Xform.Define(stage, ROOT_PRIM)
    stage.SetDefaultPrim(root.GetPrim())
    if source.twin.simulation.up == "-z":
        root.AddRotateXOp().Set(180.0)  # USD has no up axis that points down.
    shapes = _Shapes(stage)
    shapes.graph(source, codes)
    if source.splats is not None:
        shapes.splats(source, codes)
    write_atomically(output, lambda temporary: stage.GetRootLayer().Export(str(temporary)))
    return [output]


def colors(stiffness: np.ndarray) -> np.ndarray:
    """RGB [S, 3] by the logarithm of stiffness: soft springs are blue, stiff springs red."""
    logs = np.log(np.maximum(stiffness, 1e-9))
    span = np.ptp(logs) if len(logs) else 0.0
    share = (logs - logs.min()) / span if span else np.full(len(logs), 0.5)
    return np.stack([share, np.full(len(logs), 0.2), 1 - share], axis=1)


class _Shapes:
    """Adds prims to a stage."""

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self._geom, self._vt, self._sdf = (needed(f"pxr.{name}") for name in ("UsdGeom", "Vt", "Sdf"))

    def graph(self, source: ExportSource, codes: dict[int, float]) -> None:
        """Add nodes, controllers and springs, and the lines of a body other than the lattice."""
        topology, material, token = source.twin.topology, source.twin.material, self._geom.Tokens
        unit = float(np.median(topology.rest_lengths)) if len(topology.rest_lengths) else 0.01
        nodes = self._points("Nodes", NODE_WIDTH * unit, (0.8, 0.8, 0.8))
        hands = self._points("Controllers", 2 * NODE_WIDTH * unit, (1.0, 0.6, 0.1))
        springs = self._curves("Springs", [2] * len(topology.springs), SPRING_WIDTH * unit)
        self._primvar(springs, "displayColor", colors(material.stiffness), token.uniform)
        values = {"stiffness": material.stiffness, "dashpot": material.dashpot, "restLength": topology.rest_lengths}
        for name, value in values.items():
            self._primvar(springs, name, value, token.uniform)
        if source.masses.any():
            self._primvar(nodes, "mass", source.masses, token.vertex)
        lines = lines_of(source.twin)
        inner = lines.pairs[: lines.inner] if source.twin.body else lines.pairs[:0]
        body = self._curves("Body", [2] * len(inner), NODE_WIDTH * float(np.median(lines.rest_lengths))) if len(inner) else None
        if body:
            self._primvar(body, "stiffness", lines.stiffness[: lines.inner], token.uniform)
        for frame, code in codes.items():
            both = ply.points(source, frame)
            shown = {nodes: source.positions[frame], hands: source.hands[frame], springs: both[topology.springs].reshape(-1, 3)}
            if body:
                shown[body] = both[inner].reshape(-1, 3)
            for prim, points in shown.items():
                self._sample_points(prim, prim.CreatePointsAttr(), points, prim.GetWidthsAttr().Get()[0] / 2, code)

    def splats(self, source: ExportSource, codes: dict[int, float]) -> None:
        """Add splats for renderers that support Gaussians, and points (purpose proxy) for other renderers."""
        token = self._geom.Tokens
        field = needed("pxr.UsdVol").ParticleField3DGaussianSplat.Define(self._stage, f"{ROOT_PRIM}/Splats")
        stand_in = self._geom.Points.Define(self._stage, f"{ROOT_PRIM}/SplatPoints")
        image, proxy = self._geom.Imageable(field.GetPrim()), self._geom.Imageable(stand_in.GetPrim())
        image.CreatePurposeAttr(token.render)
        proxy.CreatePurposeAttr(token.proxy)
        image.SetProxyPrim(stand_in.GetPrim())
        for frame, splats in source.moved_splats(list(codes)):
            code, means, turns = codes[frame], splats.means, ply.unit_quaternions(splats)
            scales = np.exp(np.broadcast_to(splats.log_scales, means.shape))
            shades = self._vectors(splats.harmonics.reshape(-1, 3))
            coefficients = field.CreateRadianceSphericalHarmonicsCoefficientsAttr()
            if not coefficients.HasAuthoredValue():
                opacities = 1 / (1 + np.exp(-splats.opacity_logits))
                field.CreateScalesAttr(self._vectors(scales))
                field.CreateOpacitiesAttr(self._vt.FloatArray.FromNumpy(opacities))
                field.CreateRadianceSphericalHarmonicsDegreeAttr(round(splats.harmonics.shape[1] ** 0.5) - 1)
                coefficients.Set(shades)
                stand_in.CreateWidthsAttr(self._vt.FloatArray.FromNumpy((2 * scales.mean(axis=1)).astype(np.float32)))
                self._primvar(stand_in, "displayColor", np.clip(0.5 + C0 * splats.harmonics[:, 0], 0, 1), token.vertex)
                self._primvar(stand_in, "displayOpacity", opacities, token.vertex)
            if splats.harmonics[:, 1:].any():  # They rotate with the splats.
                self._sample(coefficients, shades, code)
            # pxr keeps the real part last.
            self._sample(field.CreateOrientationsAttr(), self._vt.QuatfArray.FromNumpy(np.roll(turns, -1, axis=1)), code)
            axes = Rotation.from_quat(turns, scalar_first=True).as_matrix() * scales[:, None]
            self._sample_points(field, field.CreatePositionsAttr(), means, SPLAT_REACH * np.linalg.norm(axes, axis=2), code)
            self._sample_points(stand_in, stand_in.CreatePointsAttr(), means, scales.mean(axis=1, keepdims=True), code)

    def _points(self, name: str, width: float, color: tuple[float, float, float]) -> Any:
        prim = self._geom.Points.Define(self._stage, f"{ROOT_PRIM}/{name}")
        prim.CreateWidthsAttr([width])
        prim.SetWidthsInterpolation(self._geom.Tokens.constant)
        self._primvar(prim, "displayColor", np.array([color]), self._geom.Tokens.constant)
        return prim

    def _curves(self, name: str, counts: Sequence[int], width: float) -> Any:
        prim = self._geom.BasisCurves.Define(self._stage, f"{ROOT_PRIM}/{name}")
        prim.CreateTypeAttr(self._geom.Tokens.linear)
        prim.CreateCurveVertexCountsAttr(counts)
        prim.CreateWidthsAttr([width])
        prim.SetWidthsInterpolation(self._geom.Tokens.constant)
        return prim

    def _sample_points(self, prim: Any, attribute: Any, points: np.ndarray, reach: np.ndarray | float, code: float) -> None:
        """Set points and their extent, with the margin `reach`; USD computes no extent for splats and for points of one width."""
        self._sample(attribute, self._vectors(points), code)
        if len(points):
            corners = np.stack([(points - reach).min(axis=0), (points + reach).max(axis=0)])
            self._sample(self._geom.Boundable(prim.GetPrim()).CreateExtentAttr(), self._vectors(corners), code)

    def _sample(self, attribute: Any, value: Any, code: float) -> None:
        """Set the value at a time code. The first value is also the default, the only one that Newton's importer reads."""
        if not attribute.HasAuthoredValue():
            attribute.Set(value)
        attribute.Set(value, code)

    def _vectors(self, values: np.ndarray) -> Any:
        return self._vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    def _primvar(self, prim: Any, name: str, values: np.ndarray, interpolation: str) -> None:
        """Add a primvar of colors [n, 3] or of numbers [n]."""
        kind = self._sdf.ValueTypeNames.Find("float[]" if values.ndim == 1 else "color3f[]")
        stored = self._vt.FloatArray.FromNumpy(values.astype(np.float32)) if values.ndim == 1 else self._vectors(values)
        self._geom.PrimvarsAPI(prim).CreatePrimvar(name, kind, interpolation).Set(stored)


export = Export(write=write, name="{name}.usdc", then="Next: import {output} in Blender, or open it in usdview")
