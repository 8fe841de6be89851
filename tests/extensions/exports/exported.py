"""Results folders of a tiny rope, as the workflow leaves them, for tests of exports."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import neuspring.extensions.exports
from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.core.records import Recorder
from neuspring.extensions.exports.formats import npz
from neuspring.splats.model import Splats
from neuspring.stages.rollout import rollout
from tests.support import scenarios

NODES, FRAMES = 6, 7
SPACING = 0.02
PAGE = Path(neuspring.extensions.exports.__file__).with_name("README.md")


def rope(**simulation):
    """A rope of six nodes along x, 5 cm above the ground, with springs to neighbors and next ones; one controller holds its end."""
    nodes = np.stack([np.arange(NODES) * SPACING, np.zeros(NODES), np.full(NODES, 0.05)], axis=1)
    controllers = np.array([[-0.01, 0.0, 0.055]])
    near = [(i, i + step) for step in (1, 2) for i in range(NODES - step)]
    springs = np.array([*near, (0, NODES), (1, NODES)], np.int32)
    ends = np.concatenate([nodes, controllers])[springs]
    rng = np.random.default_rng(3)
    options = {"frame_time": 1 / 30, "substeps": 60, "gravity": 9.8} | simulation
    return Twin(
        topology=Topology(
            nodes=nodes,
            controllers=controllers,
            springs=springs,
            rest_lengths=np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1),
            labels=np.arange(NODES) // 3,
        ),
        material=Material(
            stiffness=rng.uniform(150, 300, len(springs)),
            dashpot=rng.uniform(0.5, 2.0, len(springs)),
            drag=1.5,
            ground_elasticity=0.3,
            ground_friction=0.4,
            contact_elasticity=0.5,
            contact_friction=0.3,
            contact_distance=0.01,
            mass=rng.uniform(0.5, 1.5, NODES),
        ),
        simulation=Simulation(**options),
    )


def seen(twin):
    """Observations in which the hand moves up and aside."""
    times = np.arange(FRAMES)[:, None, None]
    nodes = twin.topology.nodes
    return scenarios.observations(
        frames=FRAMES,
        object_points=np.tile(nodes, (FRAMES, 1, 1)),
        object_visibility=np.ones((FRAMES, NODES), bool),
        object_motion_valid=np.ones((FRAMES, NODES), bool),
        controller_points=twin.topology.controllers + times * np.array([0.001, 0.002, 0.004]),
        surface_points=np.zeros((0, 3)),
        interior_points=np.zeros((0, 3)),
    )


def splats(count=40, degree=1):
    """Splats around the rope."""
    rng = np.random.default_rng(5)
    return Splats(
        means=rng.uniform([0, -0.01, 0.04], [0.1, 0.01, 0.06], (count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        log_scales=np.log(rng.uniform(0.002, 0.02, (count, 3))),
        opacity_logits=rng.uniform(-0.5, 4, count),
        harmonics=rng.uniform(-0.5, 0.5, (count, (degree + 1) ** 2, 3)),
    )


def run_folder(
    results,
    twin=None,
    *,
    with_splats=True,
    change=lambda observations: observations,
):
    """A run's folder with fit.json and rollout.json, its scenario's observations and, if wanted, splats."""
    twin = twin or rope()
    scenario = results / "scene"
    folder = scenario / "neuspring" / "0"
    observations = scenario / "observations.npz"
    change(seen(twin)).save(observations)
    record = Recorder("fit", folder / "fit.json")
    files = record.beside(twin="twin.npz")
    twin.save(files["twin"])
    record.save(files)
    rollout(observations=observations, learned=folder / "fit.json", device="cpu", output=folder / "rollout.json")
    if with_splats:
        trained = Recorder("appearance", scenario / "appearance" / "0" / "appearance.json")
        files = trained.beside(splats="splats.ply")
        splats().save(files["splats"])
        trained.save(files)
    return folder


def described(folder):
    """Description of exported arrays, the arrays, and sizes by symbol; asserts that every shape is as described."""
    said = json.loads((folder / npz.DESCRIPTION_FILE).read_text())
    with np.load(folder / npz.ARRAYS_FILE, allow_pickle=False) as file:
        arrays = dict(file)
    sizes = {}
    for name, entry in said["arrays"].items():
        assert list(arrays[name].shape) == entry["shape"]
        for symbol, size in zip(entry["dimensions"], entry["shape"], strict=True):
            assert size == (int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)), name
            assert symbol.isdigit() or symbol in said["sizes"]
    return said, arrays, sizes


def stretched(twin, factor):
    """The twin with other rest lengths, so that it swings from the start."""
    return replace(twin, topology=replace(twin.topology, rest_lengths=twin.topology.rest_lengths * factor))


def run_page_script(index, folder):
    """Run a Python script of the page, 0 for npz or 1 for MuJoCo, on an exported folder; returns what it prints."""
    script = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[index]
    assert "neuspring." not in script and "import neuspring" not in script
    return subprocess.run([sys.executable, "-I", "-c", script, str(folder)], capture_output=True, text=True, check=True).stdout
