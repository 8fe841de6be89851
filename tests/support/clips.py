"""The released simulator's recorded clips (tests/golden/sim_*.npz) as twins with targets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from neuspring.config import Losses
from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.twin.losses import FrameLoss

FOLDER = Path(__file__).parents[1] / "golden"
NAMES = ("cloth_selfcollision", "plush_drop_clamped", "plush_stretch", "rope_lift", "rope_push_zup")
CONTACT_SCALARS = ("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction")
"""In the order of the columns of `grad_collide`."""


@dataclass(frozen=True)
class Clip:
    """One recorded clip: a twin, what moved it, what it was fitted to, and what the released simulator answered."""

    name: str
    twin: Twin
    controllers: np.ndarray
    x: np.ndarray
    v: np.ndarray
    stiffness: np.ndarray
    stiffness_range: tuple[float, float]
    topology_params: tuple[float, int, float, int]
    object_springs: int
    surface: int
    points: np.ndarray
    visible: np.ndarray
    motion_valid: np.ndarray
    weights: Losses
    losses: np.ndarray
    grad_log_stiffness: np.ndarray
    grad_collide: np.ndarray

    @property
    def frames(self) -> range:
        """Simulated frames; frame 0 is the rest state."""
        return range(1, len(self.controllers))

    def frame_loss(self, device: str, dtype: torch.dtype) -> FrameLoss:
        """The clip's targets as a FrameLoss."""
        return FrameLoss(
            torch.tensor(self.points, dtype=dtype, device=device),
            torch.tensor(self.visible, device=device),
            torch.tensor(self.motion_valid, device=device),
            self.surface,
            self.weights,
        )


@cache
def clip(name: str) -> Clip:
    """Load sim_{name}.npz; the schema is in the golden data's README."""
    with np.load(FOLDER / f"sim_{name}.npz", allow_pickle=False) as stored:
        d = {key: stored[key] for key in stored.files}
    count = int(d["num_substeps"])
    limits = float(d["spring_Y_min"]), float(d["spring_Y_max"])
    simulation = Simulation(
        frame_time=float(d["dt"]) * count,
        substeps=count,
        up="-z" if d["reverse_z"] else "+z",
        self_collision=bool(d["self_collision"]),
    )
    topology = Topology(
        nodes=d["points"],
        controllers=d["controller_points"][0],
        springs=d["springs"],
        rest_lengths=d["rest_lengths"],
        labels=np.zeros(len(d["points"]), np.int32),
    )
    material = Material(
        stiffness=np.clip(d["spring_Y"], *limits),
        dashpot=np.full(len(d["springs"]), float(d["dashpot_damping"])),
        drag=float(d["drag_damping"]),
        ground_elasticity=float(d["collide_elas"]),
        ground_friction=float(d["collide_fric"]),
        contact_elasticity=float(d["collide_object_elas"]),
        contact_friction=float(d["collide_object_fric"]),
        contact_distance=float(d["collision_dist"]),
    )
    r_o, n_o, r_c, n_c = d["topology_params"].tolist()
    weights = Losses(chamfer=float(d["chamfer_weight"]), track=float(d["track_weight"]), acceleration=float(d["acc_weight"]))
    return Clip(
        name=name,
        twin=Twin(topology=topology, material=material, simulation=simulation),
        controllers=d["controller_points"],
        x=d["expected_x"],
        v=d["expected_v"],
        stiffness=d["spring_Y"],
        stiffness_range=limits,
        topology_params=(r_o, int(n_o), r_c, int(n_c)),
        object_springs=int(d["num_object_springs"]),
        surface=int(d["num_surface_points"]),
        points=d["gt_object_points"],
        visible=d["visibilities"].astype(bool),
        motion_valid=d["motions_valid"].astype(bool),
        weights=weights,
        losses=d["expected_losses"].astype(np.float64),
        grad_log_stiffness=d["expected_grad_log_Y"].astype(np.float64),
        grad_collide=d["expected_grad_collide"].astype(np.float64),
    )
