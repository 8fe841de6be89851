"""A small case in exactly the layout of the released data, for tests: a hanging sheet, held and moved by thirty points."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT = 64, 48
OBJECT_RADIUS, OBJECT_NEIGHBORS = 0.025, 10
CONTROLLER_RADIUS, CONTROLLER_NEIGHBORS = 0.06, 10


def dump(path: Path, value: Any, protocol: int = 4) -> None:
    """Write a pickle as the released code does (protocol 4). Tests may; the package never does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=protocol))


def final_data(frames: int, points: int, surface: int, interior: int, controllers: int, seed: int) -> dict[str, np.ndarray]:
    """The arrays of final_data.pkl, obeying every rule of the released processing."""
    rng = np.random.default_rng(seed)
    rest = np.unique(rng.uniform([-0.05, -0.05, -0.1], [0.05, 0.05, -0.02], (points, 3)), axis=0)
    motion = np.linspace(0, 1, frames)[:, None] * np.array([0.02, 0.0, -0.03])
    visible = rng.uniform(size=(frames, points)) > 0.15
    visible[0] = True
    visible[:, 0] = True
    valid = np.zeros_like(visible)
    valid[:-1] = visible[:-1] & visible[1:]
    hands = rest[rng.integers(points, size=controllers)] + rng.uniform(0.002, 0.004, (controllers, 3))
    return {
        "object_points": np.where(visible[..., None], rest + motion[:, None], 0.0),
        "object_colors": np.where(visible[..., None], 0.5, 0.0) * np.ones(3),
        "object_visibilities": visible,
        "object_motions_valid": valid,
        "controller_points": hands + motion[:, None],
        "surface_points": rng.uniform([-0.05, -0.05, -0.1], [0.05, 0.05, -0.02], (surface, 3)),
        "interior_points": rng.uniform([-0.05, -0.05, -0.1], [0.05, 0.05, -0.02], (interior, 3)),
        "controller_mask": np.arange(controllers),
    }


def camera() -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrix of a camera 0.5 m above the table looking down, and intrinsics with an off-center c_x."""
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, -0.5]
    return pose, np.array([[60.0, 0.0, WIDTH / 2 + 5.0], [0.0, 60.0, HEIGHT / 2], [0.0, 0.0, 1.0]])


def write_case(
    root: Path,
    name: str = "single_lift_thing",
    *,
    frames: int = 10,
    points: int = 40,
    surface: int = 12,
    interior: int = 6,
    controllers: int = 30,
    tracks: int = 5,
    seed: int = 0,
) -> Path:
    """Write root/data/different_types/{name} (processed files, calibration, metadata) and return that folder."""
    folder = root / "data" / "different_types" / name
    data = final_data(frames, points, surface, interior, controllers, seed)
    dump(folder / "final_data.pkl", data)
    end = int(0.7 * frames)
    write_json(folder / "split.json", {"frame_len": frames, "train": [0, end], "test": [end, frames]})
    annotated = data["object_points"][:, :tracks].copy()
    annotated[~data["object_visibilities"][:, :tracks]] = np.nan
    dump(folder / "gt_track_3d.pkl", annotated)
    pose, intrinsics = camera()
    dump(folder / "calibrate.pkl", [pose] * 3)
    metadata = {"intrinsics": [intrinsics.tolist()] * 3, "serial_numbers": ["0", "1", "2"], "fps": 30, "WH": [WIDTH, HEIGHT]}
    write_json(folder / "metadata.json", metadata | {"frame_num": frames, "start_step": 0, "end_step": frames})
    return folder


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file."""
    path.write_text(json.dumps(value), encoding="utf-8")


def write_results(folder: Path) -> None:
    """Write the released result files of the case `folder`: a prediction equal to its rest state, parameters, a checkpoint."""
    import torch

    from neuspring.physics.topology import uniform_topology

    root, name = folder.parents[2], folder.name
    data = pickle.loads((folder / "final_data.pkl").read_bytes())
    rest = np.concatenate([data["object_points"][0], data["surface_points"], data["interior_points"]]).astype(np.float32)
    motion = data["controller_points"][:, 0] - data["controller_points"][0, 0]
    dump(root / "experiments" / name / "inference.pkl", (rest + motion[:, None]).astype(np.float32))
    hands = data["controller_points"][0].astype(np.float32)
    topology = uniform_topology(rest, hands, OBJECT_RADIUS, OBJECT_NEIGHBORS, CONTROLLER_RADIUS, CONTROLLER_NEIGHBORS)
    parameters = {
        "global_spring_Y": np.float64(3e4),
        "object_radius": np.float64(OBJECT_RADIUS),
        "object_max_neighbours": OBJECT_NEIGHBORS,
        "controller_radius": np.float64(CONTROLLER_RADIUS),
        "controller_max_neighbours": CONTROLLER_NEIGHBORS,
        "collide_elas": np.float32(0.5),
        "collide_fric": np.float32(0.3),
        "collide_object_elas": np.float32(0.7),
        "collide_object_fric": np.float32(0.3),
        "collision_dist": np.float64(0.02),
        "drag_damping": np.float64(3.5),
        "dashpot_damping": np.float64(100.5),
    }
    dump(root / "experiments_optimization" / name / "optimal_params.pkl", parameters)
    checkpoint = root / "experiments" / name / "train" / "best_199.pth"
    checkpoint.parent.mkdir(parents=True)
    stiffness = torch.full((len(topology.springs),), 3e4)
    torch.save({"epoch": 199, "num_object_springs": topology.object_spring_count, "spring_Y": stiffness}, checkpoint)


def write_raw_frame(folder: Path, *, mirrored: bool) -> None:
    """Write the same depth and tracks of frame 0 for all cameras, and make the points of frame 0 their lift.

    They are lifted with c_x, or with the mirrored W - c_x.
    """
    rng = np.random.default_rng(1)
    pose, intrinsics = camera()
    pixels = rng.permutation(WIDTH * HEIGHT)[:200]
    row, column = pixels // WIDTH, pixels % WIDTH
    depth = rng.integers(300, 480, (HEIGHT, WIDTH)).astype(np.uint16)
    z = depth[row, column] / 1000
    center = WIDTH - intrinsics[0, 2] if mirrored else intrinsics[0, 2]
    lifted = np.stack([z * (column - center) / 60, z * (row - intrinsics[1, 2]) / 60, z], axis=1) + pose[:3, 3]
    data = pickle.loads((folder / "final_data.pkl").read_bytes())
    points = np.unique(lifted, axis=0)[: data["object_points"].shape[1]]
    data["object_points"][0] = points
    dump(folder / "final_data.pkl", data)
    visible = (lifted[:, None] == points[None]).all(axis=2).any(axis=1)
    (folder / "cotracker").mkdir()
    tracks = np.stack([row, column], axis=1).astype(np.float32)[None]
    for index in "012":
        (folder / "depth" / index).mkdir(parents=True)
        np.save(folder / "depth" / index / "0.npy", depth)
        np.savez(folder / "cotracker" / f"{index}.npz", tracks=tracks, visibility=visible[None])


def edit(folder: Path, **changes: Any) -> None:
    """Replace keys of final_data.pkl (None removes a key)."""
    path = folder / "final_data.pkl"
    data = pickle.loads(path.read_bytes())
    for key, value in changes.items():
        if value is None:
            del data[key]
        else:
            data[key] = value
    dump(path, data)


def stored(folder: Path) -> dict[str, np.ndarray]:
    """The arrays of final_data.pkl."""
    data: dict[str, np.ndarray] = pickle.loads((folder / "final_data.pkl").read_bytes())
    return data
