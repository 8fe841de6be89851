"""A rod as a chain of rigid edges, in MuJoCo's bodies. MuJoCo 4 has no cable plugin, which also had one stiffness for all joints.

- The rest pose is the unloaded shape (unloaded curvatures, no twist); the keyframe `start` is frame 0. A body's axes are t, m1,
  m2.
- Two edges have three hinges: about t with stiffness GJ / l, about m1 and m2 with EI / l. Each has the rod's damping times this.
- Edges are rigid, with their mass along them. A clamp is a mocap body to which the end is welded. Drag is omitted.
- Rods that slip inside raise InputError: a branch is a spring in series with friction, but hinges have both in parallel.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.extensions.rods.nodes import frame_zero, radius_of
from neuspring.extensions.rods.rod import Rod, rod_of

CABLE_STEP = 2e-4
"""Maximum time step, s, because MuJoCo integrates the springs of joints explicitly."""
THICKNESS = 0.002
"""Minimum radius, m, because nodes on the line give no radius."""
WELD: dict[str, Any] = {"solref": f"{2 * CABLE_STEP} 1", "solimp": "0.999 0.9999 1e-4"}
"""A clamp is as stiff as the time step allows."""


HINGE_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def text(*values: float | np.floating) -> str:
    """Numbers for MJCF, which keep every bit of a float32."""
    return " ".join(f"{float(value):.9g}" for value in values)


class to_mujoco:
    """The rod for the format `mujoco` (`BODY_EXPORTS`)."""

    step = CABLE_STEP

    def __init__(self, twin: Twin) -> None:
        self.rod = rod_of(twin)
        self.radius = max(radius_of(self.rod), THICKNESS)

    def add(self, root: ET.Element, world: ET.Element, meets: dict[str, Any]) -> None:
        """Add the chain edge0, edge1, ..., one site per node, the clamps clamp0 and clamp1, and the keyframe `start`."""
        rod, radius = self.rod, self.radius
        edges = len(rod.lengths)
        mass, bend, twist, frames, rest, held = chain_of(rod)
        pose = [*rod.vertices[0], *frames[0].as_quat(scalar_first=True)]
        parent = world
        at: dict[str, Any] = {"pos": text(*rod.vertices[0]), "quat": text(*pose[3:])}
        for j in range(edges):
            parent = ET.SubElement(parent, "body", name=f"edge{j}", **at)
            if j:
                for axis, k in zip(HINGE_AXES, (twist[j - 1], bend[j - 1], bend[j - 1]), strict=True):
                    law: dict[str, Any] = {"stiffness": text(k), "damping": text(rod.damping * k)}
                    ET.SubElement(parent, "joint", name=f"joint{j}{axis}", type="hinge", axis=HINGE_AXES[axis], **law)
                pose += (rest[j - 1].inv() * frames[j - 1].inv() * frames[j]).as_euler("XYZ").tolist()
            else:
                ET.SubElement(parent, "freejoint", name="joint0")
            along: dict[str, Any] = {"type": "capsule", "fromto": text(0, 0, 0, rod.lengths[j], 0, 0), "mass": text(mass[j])}
            ET.SubElement(parent, "geom", size=text(radius), **along, **meets)
            for n in np.flatnonzero(rod.edge == j):
                f, a, b = rod.place[n]
                ET.SubElement(parent, "site", name=f"node{n}", pos=text(f * rod.lengths[j], a, b), size=text(radius / 4))
            if j + 1 < edges:
                at = {"pos": text(rod.lengths[j], 0, 0), "quat": text(*rest[j].as_quat(scalar_first=True))}
        equality = ET.SubElement(root, "equality") if held else root
        for number, edge in held.items():
            quat = text(*frames[edge].as_quat(scalar_first=True))
            ET.SubElement(world, "body", name=f"clamp{number}", pos=text(*rod.vertices[edge]), quat=quat, mocap="true")
            ET.SubElement(equality, "weld", body1=f"clamp{number}", body2=f"edge{edge}", relpose="0 0 0 1 0 0 0", **WELD)
        ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="start", qpos=text(*pose))


class Chain(NamedTuple):
    """A rod as rigid edges with springs at the joints."""

    mass: np.ndarray
    """Mass of each edge [E], kg; adjacent edges share the mass of a vertex."""
    bend: np.ndarray
    """EI / l of each joint [E - 1], N m."""
    twist: np.ndarray
    """GJ / l of each joint [E - 1], N m."""
    frames: Rotation
    """Axes t, m1, m2 of each edge in frame 0 [E]."""
    rest: Rotation
    """Rotation from each edge to the next without moments [E - 1]."""
    held: dict[int, int]
    """Clamped end, 0 or 1 -> its edge."""


def chain_of(rod: Rod) -> Chain:
    """The edges and joints of a rod. Raises InputError if it slips inside."""
    if len(rod.slip):
        rule = "MuJoCo supports no branches that slip"
        raise InputError("--to", rule, f"{len(rod.slip)} (Rod.slip)", "Use --to npz, or fit a rod with fit.rod.slip = 0.")
    edges = len(rod.lengths)
    share = rod.mass / np.where(np.isin(np.arange(edges + 1), (0, edges)), 1, 2)
    spans = rod.spans[1:-1]
    ends = {0: (0, rod.held[:2]), 1: (edges - 1, rod.held[-2:])}
    held = {end: edge for end, (edge, hands) in ends.items() if (hands >= 0).all()}
    bend, twist = rod.bending[1:-1] / spans, rod.twisting[1:-1] / spans
    return Chain(share[:-1] + share[1:], bend, twist, frames_of(rod), _rest(rod.curvature, bool(rod.by_angle)), held)


def frames_of(rod: Rod) -> Rotation:
    """The axes t, m1, m2 of each edge in frame 0."""
    m1, along = frame_zero(rod)[0], np.diff(rod.vertices, axis=0)
    t = along / np.linalg.norm(along, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([t, m1, np.cross(t, m1)], axis=2))


def _rest(curvature: np.ndarray, by_angle: bool = False) -> Rotation:
    """The rotation from each edge to the next without moments: about (0, -k2, k1) by 2 atan(|k| / 2), or by |k| (`by_angle`)."""
    k = np.stack([np.zeros(len(curvature) - 2), -curvature[1:-1, 1], curvature[1:-1, 0]], axis=1)
    size = np.linalg.norm(k, axis=1, keepdims=True)
    angle = size if by_angle else 2 * np.arctan(size / 2)
    return Rotation.from_rotvec(angle * k / np.maximum(size, 1e-12))
