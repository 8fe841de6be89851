"""The released PhysTwin simulator behind the interface of the benchmark, from a checkout of the user: `--peer PATH`.

The checkout is not changed. Its simulator and settings are copied to a temporary folder, where the device name is replaced, and
imported from there. This executes code of the checkout, which is not part of this project.

As in PhysTwin's trainer, a frame is recorded as a graph: the substeps, or the substeps, a loss and the tape's backward pass. The
time includes the trainer's work per frame: setting the state and the controllers, and clearing gradients. The optimizer is left
out. The loss is PhysTwin's simple loss for synthetic data (`simulators.LOSS`), because the Chamfer distance is not part of the
simulation.
"""

from __future__ import annotations

import importlib
import shutil
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
import torch
import warp as wp

from neuspring.core.artifacts import Twin
from neuspring.core.device import start_warp
from neuspring.core.errors import InputError
from results.published.bench.simulators import Frame

PACKAGE = "qqtt"
SIMULATOR = Path(PACKAGE, "model", "diff_simulator", "spring_mass_warp.py")
SETTINGS = [Path(PACKAGE, "utils", name) for name in ("config.py", "misc.py")]
DEVICE = 'wp.set_device("cuda:0")'
SYSTEM = "SpringMassSystemWarp"
UTILITIES = """import logging
from .config import cfg
logger = logging.getLogger("peer")
"""
"""Replaces the checkout's utilities, which also import viewers."""
ANY_STIFFNESS = (0.0, 1e9)
"""Limits of the stiffness, N, wide enough to have no effect."""


class PhysTwin:
    """The simulator of a checkout on a device.

    Raises InputError if the folder is not a checkout, or has a version that this adapter does not know.
    """

    name = "PhysTwin"

    def __init__(self, checkout: Path, device: str = "cpu") -> None:
        self.device = device
        self._folder = tempfile.TemporaryDirectory(prefix="peer-")
        stem = "simulator_" + device.replace(":", "_")
        copy(checkout, Path(self._folder.name), stem, device)
        self._module, self._settings = imported(Path(self._folder.name), stem, device)
        if not hasattr(self._module, SYSTEM):
            raise InputError(checkout / SIMULATOR, f"must define {SYSTEM}", None, "Pass another version to --peer.")

    def forward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame, as in its inference."""
        system = self._system(twin, hands)
        with wp.ScopedCapture(device=self.device) as capture:
            system.step()

        def run() -> None:
            with wp.ScopedDevice(self.device):
                self._begin(system, inference=True)
                wp.capture_launch(capture.graph)

        return Frame(run, lambda: positions(system))

    def forward_backward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame and its gradient, as in its training."""
        system = self._system(twin, hands)
        with wp.ScopedCapture(device=self.device) as capture:
            tape = wp.Tape()
            with tape:
                system.step()
                system.calculate_simple_loss()
            tape.backward(system.loss)

        def run() -> None:
            with wp.ScopedDevice(self.device):
                # The trainer does this after a frame. Doing it before keeps the gradient readable after the run.
                tape.zero()
                system.clear_loss()
                self._begin(system, inference=False)
                wp.capture_launch(capture.graph)

        return Frame(run, lambda: positions(system), lambda: system.wp_spring_Y.grad.numpy().copy())

    def _begin(self, system: Any, *, inference: bool) -> None:
        """Set the state at rest and the controllers of the frame."""
        system.set_init_state(system.wp_init_vertices, system.wp_init_velocities, pure_inference=inference)
        system.set_controller_target(1, pure_inference=inference)
        if system.object_collision_flag:
            system.update_collision_graph()

    def _system(self, twin: Twin, hands: np.ndarray) -> Any:
        """A twin in PhysTwin's form: unit masses, log stiffness, one dashpot for all springs."""
        topology, material, simulation = twin.topology, twin.material, twin.simulation
        dashpot = single_dashpot(twin)
        options: dict[str, Any] = {"dtype": torch.float32, "device": self.device}
        path = torch.tensor(hands, **options)
        count = len(topology.nodes)
        # If set, PhysTwin records its own graph with its own loss.
        self._settings.use_graph = False
        low, high = ANY_STIFFNESS
        with wp.ScopedDevice(self.device):
            return getattr(self._module, SYSTEM)(
                torch.cat([torch.tensor(topology.nodes, **options), path[0]]),
                torch.tensor(topology.springs, dtype=torch.int32, device=self.device),
                torch.tensor(topology.rest_lengths, **options),
                torch.ones(count + path.shape[1], **options),
                simulation.substep,
                simulation.substeps,
                np.array(material.stiffness),
                material.ground_elasticity,
                material.ground_friction,
                dashpot,
                material.drag,
                collide_object_elas=material.contact_elasticity,
                collide_object_fric=material.contact_friction,
                collision_dist=material.contact_distance,
                self_collision=simulation.self_collision,
                num_object_points=count,
                num_surface_points=count,
                num_original_points=count,
                controller_points=path,
                reverse_z=simulation.up == "-z",
                spring_Y_min=low,
                spring_Y_max=high,
                gt_object_points=torch.zeros((2, count, 3), **options),
                gt_object_visibilities=torch.ones((2, count), **options),
                gt_object_motions_valid=torch.ones((2, count), **options),
            )


def copy(checkout: Path, folder: Path, stem: str, device: str) -> None:
    """Copy the simulator and its settings into a package in `folder`; the simulator becomes module `stem` for a device."""
    for name in (SIMULATOR, *SETTINGS):
        if not (checkout / name).is_file():
            rule = f"must be a checkout of PhysTwin with {name}"
            raise InputError("--peer", rule, checkout, "Pass the folder that git clone created.")
    text = (checkout / SIMULATOR).read_text(encoding="utf-8")
    if DEVICE not in text:
        raise InputError(checkout / SIMULATOR, f"must set its device by {DEVICE}", None, "Change DEVICE in this adapter.")
    utilities = folder / PACKAGE / "utils"
    utilities.mkdir(parents=True)
    (folder / PACKAGE / "__init__.py").touch()
    (utilities / "__init__.py").write_text(UTILITIES, encoding="utf-8")
    for name in SETTINGS:
        shutil.copy(checkout / name, utilities)
    (folder / PACKAGE / f"{stem}.py").write_text(text.replace(DEVICE, f'wp.set_device("{device}")'), encoding="utf-8")


def imported(folder: Path, stem: str, device: str) -> tuple[ModuleType, Any]:
    """The module and its settings, with all kernels and adjoints compiled, because a graph capture cannot load any."""
    start_warp()
    before = wp.get_device()
    # Import from `folder` only and forget the modules: a copy for another device has the same names. Warp makes the adjoints.
    with (
        mock.patch.dict(sys.modules),
        mock.patch.object(sys, "path", [str(folder), *sys.path]),
        mock.patch.object(wp.config, "enable_backward", True),
    ):
        for name in [name for name in sys.modules if name.split(".")[0] == PACKAGE]:
            del sys.modules[name]
        importlib.invalidate_caches()
        try:
            module = importlib.import_module(f"{PACKAGE}.{stem}")
        finally:
            wp.set_device(before)  # the module sets it
        settings = sys.modules[f"{PACKAGE}.utils"].cfg
        settings.device = device
        wp.load_module(module.__name__, device=device)
    return module, settings


def single_dashpot(twin: Twin) -> float:
    """The dashpot of all springs, N s/m. Raises InputError if PhysTwin cannot simulate the twin."""
    simulation, dashpot = twin.simulation, twin.material.dashpot
    if np.ptp(dashpot) > 0:
        raise InputError("material.dashpot", "must be equal for all springs with a peer", f"{dashpot.min()} to {dashpot.max()}")
    if not simulation.ground or simulation.gravity != 9.8 or simulation.controller_velocity:
        rule = "must have a ground, a gravity of 9.8 m/s^2 and no controller velocity in dashpots with a peer"
        raise InputError("simulation", rule, simulation)
    return float(dashpot[0])


def positions(system: Any) -> np.ndarray:
    """Positions at the end of the frame [N, 3], m."""
    after: np.ndarray = system.wp_states[-1].wp_x.numpy().copy()
    return after
