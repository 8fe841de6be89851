"""A twin for other simulators, beside the plain export: the script that makes Newton's model of it, and MuJoCo's MJCF file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.export import plain
from neuspring.export.source import Source

SCRIPT = Path(__file__).with_name("newton_twin.py")
MODEL = "twin.xml"
AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def write_newton(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write arrays.npz, description.json and newton_twin.py to the folder `output`."""
    require_start(frames)
    write_text(output / SCRIPT.name, SCRIPT.read_text(encoding="utf-8"))
    return [*plain.write(source, frames, output), output / SCRIPT.name]


def write_mujoco(source: Source, frames: Sequence[int], output: Path) -> list[Path]:
    """Write twin.xml, and arrays.npz and description.json for the hands' motion, to the folder `output`."""
    require_start(frames)
    write_text(output / MODEL, mjcf(source))
    return [output / MODEL, *plain.write(source, frames, output)]


def require_start(frames: Sequence[int]) -> None:
    """Raise InputError unless the frames are 0, 1, 2, ...: a simulator needs the hands from the start on."""
    if list(frames) != list(range(len(frames))):
        rule = "a simulator needs the hands of all frames from 0 on"
        raise InputError("--frames", rule, f"{frames[0]} to {frames[-1]}, {len(frames)} frames", "Take 0:STOP, or leave it out.")


def mjcf(source: Source) -> str:
    """Nodes as bodies on three slides, springs as spatial tendons, controllers as mocap bodies, with our time step.

    A tendon's force is stiffness (l - springlength) + damping dl/dt, so it is our spring with stiffness / rest length. Slides damp
    as our drag does. MuJoCo's ground is soft. Bodies and sites are node0, node1, ..., hand0, ..., tendons spring0, ...
    """
    twin = source.twin
    simulation, material, topology = twin.simulation, twin.material, twin.topology
    radius = material.contact_distance / 2
    root = ET.Element("mujoco", model=source.name)
    gravity = (0, 0, -simulation.gravity * simulation.up_sign)
    ET.SubElement(root, "option", timestep=_text(simulation.substep), integrator="Euler", gravity=_text(*gravity))
    world = ET.SubElement(root, "worldbody")
    if simulation.ground:
        # Nodes are points for us and balls here, which touch a plane that is lower by their radius.
        height, turn = -radius * simulation.up_sign, "0 0 0" if simulation.up == "+z" else "180 0 0"
        friction = _text(material.ground_friction, 0.005, 0.0001)
        kind: dict[str, Any] = {"type": "plane", "size": "5 5 0.1", "contype": "1", "conaffinity": "0", "friction": friction}
        ET.SubElement(world, "geom", name="ground", pos=_text(0, 0, height), euler=turn, **kind)
    # The plane meets nodes; nodes meet each other only with self-collision.
    meets: dict[str, Any] = {"contype": "1" if simulation.self_collision else "0", "conaffinity": "1"}
    for index, (place, mass) in enumerate(zip(topology.nodes, source.masses, strict=True)):
        body = ET.SubElement(world, "body", name=f"node{index}", pos=_text(*place))
        for axis, direction in AXES.items():
            damping = _text(material.drag * float(mass))
            ET.SubElement(body, "joint", name=f"node{index}{axis}", type="slide", axis=direction, damping=damping)
        ET.SubElement(body, "geom", type="sphere", size=_text(radius), mass=_text(mass), **meets)
        ET.SubElement(body, "site", name=f"node{index}", size=_text(radius))
    for index, place in enumerate(topology.controllers):
        body = ET.SubElement(world, "body", name=f"hand{index}", pos=_text(*place), mocap="true")
        ET.SubElement(body, "site", name=f"hand{index}", size=_text(radius), rgba="1 0.6 0.1 1")
    tendons = ET.SubElement(root, "tendon") if len(topology.springs) else root
    names = [f"node{index}" for index in range(len(topology.nodes))] + [f"hand{c}" for c in range(len(topology.controllers))]
    columns = (topology.springs, material.stiffness, topology.rest_lengths, material.dashpot)
    for index, (ends, stiffness, length, dashpot) in enumerate(zip(*columns, strict=True)):
        force = _text(float(stiffness) / float(length))
        law: dict[str, Any] = {"stiffness": force, "damping": _text(dashpot), "springlength": _text(length)}
        tendon = ET.SubElement(tendons, "spatial", name=f"spring{index}", width=_text(radius / 5), **law)
        for end in ends:
            ET.SubElement(tendon, "site", site=names[end])
    if source.velocity.any():
        keys = ET.SubElement(root, "keyframe")
        ET.SubElement(keys, "key", name="start", qvel=_text(*source.velocity.ravel()))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _text(*values: float | np.floating) -> str:
    """Numbers as MJCF has them; float32 to the last bit."""
    return " ".join(f"{float(value):.9g}" for value in values)
