"""The released simulator's recorded clips (tests/golden/sim_*.npz) as twins with targets."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from neuspring.config import Losses
from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.twin.losses import FrameLoss

FOLDER = Path(__file__).parents[1] / "golden"
NAMES = ("cloth_selfcollision", "plush_drop_clamped", "plush_stretch", "rope_lift", "rope_push_zup")
CONTACT_SCALARS = ("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction")
"""In the order of the columns of `grad_collide`."""


RECORDED = {
    "controllers": "controller_points",
    "x": "expected_x",
    "v": "expected_v",
    "stiffness": "spring_Y",
    "points": "gt_object_points",
    "visible": "visibilities",
    "motion_valid": "motions_valid",
    "losses": "expected_losses",
    "grad_log_stiffness": "expected_grad_log_Y",
    "grad_collide": "expected_grad_collide",
}
"""Arrays of a clip, and their names in its file; the schema is in the golden data's README."""


WEIGHTS = {"chamfer": "chamfer", "track": "track", "acceleration": "acc"}
"""Terms of the loss, and their names in its file."""


class Clip(SimpleNamespace):
    """One recorded clip: a twin, what moved it, what it was fitted to, and what the released simulator answered.

    Beside the arrays of RECORDED: name, twin, weights, stiffness_range, topology_params, and the counts surface and object_springs.
    """

    @property
    def frames(self):
        """Simulated frames; frame 0 is the rest state."""
        return range(1, len(self.controllers))

    def frame_loss(self, device, dtype):
        """The clip's targets as a FrameLoss."""
        points = torch.tensor(self.points, dtype=dtype, device=device)
        seen = (torch.tensor(values.astype(bool), device=device) for values in (self.visible, self.motion_valid))
        return FrameLoss(points, *seen, self.surface, self.weights)


@cache
def clip(name):
    """The clip of sim_{name}.npz."""
    with np.load(FOLDER / f"sim_{name}.npz", allow_pickle=False) as stored:
        d = {key: stored[key] for key in stored.files}
    count = int(d["num_substeps"])
    limits = float(d["spring_Y_min"]), float(d["spring_Y_max"])
    world = {"up": "-z" if d["reverse_z"] else "+z", "self_collision": bool(d["self_collision"])}
    topology = Topology(
        nodes=d["points"],
        controllers=d["controller_points"][0],
        springs=d["springs"],
        rest_lengths=d["rest_lengths"],
        labels=np.zeros(len(d["points"]), np.int32),
    )
    names = ("collide_elas", "collide_fric", "collide_object_elas", "collide_object_fric")
    material = Material(
        stiffness=np.clip(d["spring_Y"], *limits),
        dashpot=np.full(len(d["springs"]), float(d["dashpot_damping"])),
        drag=float(d["drag_damping"]),
        contact_distance=float(d["collision_dist"]),
        **{scalar: float(d[stored]) for scalar, stored in zip(CONTACT_SCALARS, names, strict=True)},
    )
    simulation = Simulation(frame_time=float(d["dt"]) * count, substeps=count, **world)
    r_o, n_o, r_c, n_c = d["topology_params"].tolist()
    arrays = {field: d[stored] for field, stored in RECORDED.items()}
    arrays |= {field: arrays[field].astype(np.float64) for field in ("losses", "grad_log_stiffness", "grad_collide")}
    return Clip(
        name=name,
        twin=Twin(topology=topology, material=material, simulation=simulation),
        weights=Losses(**{term: float(d[f"{short}_weight"]) for term, short in WEIGHTS.items()}),
        stiffness_range=limits,
        topology_params=(r_o, int(n_o), r_c, int(n_c)),
        surface=int(d["num_surface_points"]),
        object_springs=int(d["num_object_springs"]),
        **arrays,
    )
