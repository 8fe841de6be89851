"""A small case in exactly the layout of the released data, for tests: a hanging sheet, held and moved by thirty points."""

import json
import pickle

import numpy as np

from neuspring.data.unpickle import load_pickle

WIDTH, HEIGHT = 64, 48


def dump(path, value, protocol=4):
    """Write a pickle as the released code does (protocol 4). Tests may; the package never does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=protocol))


def final_data(frames, points, surface, interior, controllers, seed):
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


def camera():
    """Camera-to-world matrix of a camera 0.5 m above the table looking down, and intrinsics with an off-center c_x."""
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, -0.5]
    return pose, np.array([[60.0, 0.0, WIDTH / 2 + 5.0], [0.0, 60.0, HEIGHT / 2], [0.0, 0.0, 1.0]])


def write_case(
    root,
    name="single_lift_thing",
    *,
    frames=10,
    points=40,
    surface=12,
    interior=6,
    controllers=30,
    tracks=5,
    seed=0,
):
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


def write_json(path, value):
    """Write a JSON file."""
    path.write_text(json.dumps(value), encoding="utf-8")


def edit(folder, **changes):
    """Replace keys of final_data.pkl (None removes a key)."""
    path = folder / "final_data.pkl"
    data = load_pickle(path)
    for key, value in changes.items():
        if value is None:
            del data[key]
        else:
            data[key] = value
    dump(path, data)


def stored(folder):
    """The arrays of final_data.pkl."""
    return load_pickle(folder / "final_data.pkl")
