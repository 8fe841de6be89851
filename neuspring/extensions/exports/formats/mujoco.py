"""MuJoCo: an MJCF file, and the files of the format `npz` with the motion of the controllers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from neuspring.core.files import write_text
from neuspring.extensions.exports import Export, of_body
from neuspring.extensions.exports.formats import npz
from neuspring.extensions.exports.source import ExportSource, require_start
from neuspring.twin.rollout import FAR_AWAY

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
MODEL = "twin.xml"
GROUND_TIME = 4
"""Time constant of contacts with the ground, in time steps; MuJoCo requires 2 or more."""


def text(*values: float | np.floating) -> str:
    """Numbers for MJCF, which keep every bit of a float32."""
    return " ".join(f"{float(value):.9g}" for value in values)


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write twin.xml, arrays.npz and description.json to the folder `output`."""
    require_start(frames)
    write_text(output / MODEL, mjcf(source))
    return [output / MODEL, *npz.write(source, frames, output)]


def mjcf(source: ExportSource) -> str:
    """MJCF: nodes are bodies on three slides, springs spatial tendons, controllers mocap bodies; the time step is the twin's.

    - A tendon has the force stiffness (l - springlength) + damping dl/dt: a spring of the twin, divided by its rest length.
    - A tendon that only pushes has no stiffness beyond its rest length, but keeps its damping.
    - Slides have the damping of the twin's drag.
    - Bodies and sites are called node0, node1, ..., hand0, ...; tendons spring0, ...

    For two geoms of equal priority MuJoCo uses the larger friction (1.0 by default) and the mean solref, so the ground has a
    higher priority. Its contacts are as hard as the time step allows. Friction has an elliptic cone, because MuJoCo's default
    pyramid brakes differently along the diagonals.

    Other bodies are written by their package (`BODY_EXPORTS`): MuJoCo bodies with one site per node, and a maximum time step.
    """
    twin = source.twin
    simulation, material, topology = twin.simulation, twin.material, twin.topology
    root = ET.Element("mujoco", model=source.name)
    write_body = of_body(twin, "mujoco")
    chain = write_body(twin) if write_body else None
    radius = chain.radius if chain else material.contact_distance / 2
    step, integrator = (min(simulation.substep, chain.step), "implicitfast") if chain else (simulation.substep, "Euler")
    gravity = text(0, 0, -simulation.gravity * simulation.up_sign)
    ET.SubElement(root, "option", timestep=text(step), integrator=integrator, gravity=gravity, cone="elliptic")
    world = ET.SubElement(root, "worldbody")
    if simulation.ground:
        # The twin's nodes are points and MuJoCo's are balls, so the plane is lower by their radius.
        height, turn = -radius * simulation.up_sign, "0 0 0" if simulation.up == "+z" else "180 0 0"
        friction = text(material.ground_friction, 0.005, 0.0001)
        kind: dict[str, Any] = {"type": "plane", "size": "5 5 0.1", "contype": "1", "conaffinity": "0", "friction": friction}
        kind |= {"priority": "1", "solref": text(GROUND_TIME * step, 1)}
        ET.SubElement(world, "geom", name="ground", pos=text(0, 0, height), euler=turn, **kind)
    # The plane meets nodes; nodes meet each other only with self-collision.
    meets: dict[str, Any] = {"contype": "1" if simulation.self_collision else "0", "conaffinity": "1"}
    meets["friction"] = text(material.contact_friction, 0.005, 0.0001)
    if chain:
        chain.add(root, world, meets)
    for index, (position, mass) in enumerate(zip(topology.nodes, source.masses, strict=True) if not chain else ()):
        body = ET.SubElement(world, "body", name=f"node{index}", pos=text(*position))
        for axis, direction in AXES.items():
            damping = text(material.drag * float(mass))
            ET.SubElement(body, "joint", name=f"node{index}{axis}", type="slide", axis=direction, damping=damping)
        ET.SubElement(body, "geom", type="sphere", size=text(radius), mass=text(mass), **meets)
        ET.SubElement(body, "site", name=f"node{index}", size=text(radius))
    for index, position in enumerate(topology.controllers):
        body = ET.SubElement(world, "body", name=f"hand{index}", pos=text(*position), mocap="true")
        ET.SubElement(body, "site", name=f"hand{index}", size=text(radius), rgba="1 0.6 0.1 1")
    tendons = ET.SubElement(root, "tendon") if len(topology.springs) else root
    names = [f"node{index}" for index in range(len(topology.nodes))] + [f"hand{c}" for c in range(len(topology.controllers))]
    pushes = topology.pushes if topology.pushes.size else np.zeros(len(topology.springs), bool)
    columns = (topology.springs, material.stiffness, topology.rest_lengths, material.dashpot, pushes)
    for index, (ends, stiffness, length, dashpot, push) in enumerate(zip(*columns, strict=True)):
        force = text(float(stiffness) / float(length))
        # A tendon has no force between its two spring lengths.
        free = text(length, FAR_AWAY) if push else text(length)
        law: dict[str, Any] = {"stiffness": force, "damping": text(dashpot), "springlength": free}
        tendon = ET.SubElement(tendons, "spatial", name=f"spring{index}", width=text(radius / 5), **law)
        for end in ends:
            ET.SubElement(tendon, "site", site=names[end])
    if not chain and source.velocity.any():
        ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="start", qvel=text(*source.velocity.ravel()))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


export = Export(
    write=write,
    name="{name}_mujoco",
    then="Next: save the MuJoCo script of neuspring/extensions/exports/README.md as run.py; .venv/bin/python run.py {output}",
)
