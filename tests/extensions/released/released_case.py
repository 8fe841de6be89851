"""A small case with everything that PhysTwin released about it, in its layout, made by other code than that which is checked:

prediction by the float64 reference simulation, pictures by the rasterizer's specification, deprojection written out.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Material, Simulation, Twin
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.released.checks import Published
from neuspring.extensions.released.files import Released
from neuspring.physics import reference as simulation
from neuspring.physics.reference import ReferenceTwin
from neuspring.physics.topology import uniform_topology
from neuspring.scores.paper import released_scores
from neuspring.splats.model import Splats
from neuspring.splats.rasterize import reference
from neuspring.splats.skinning import Skin
from neuspring.splats.view import C0, View
from tests.support.phystwin_case import dump, edit, stored, write_case, write_json

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
CENTERS = ((37.0, 24.0), (35.5, 25.0), (30.5, 23.0))
"""Principal points of the three cameras."""
FRAMES, POINTS = 6, 40
TRAIN_END = int(0.7 * FRAMES)
SPLITS = {"train": range(1, TRAIN_END), "future": range(TRAIN_END, FRAMES)}
DRAG, DASHPOT = 3.7, 40.9
SPLATS = "init=hybrid_iso=True_ldepth=0.001_lnormal=0.0_laniso_0.0_lseg=1.0/point_cloud/iteration_10000/point_cloud.ply"
HUMAN_COLUMNS = slice(44, 50)


def write_released(root: Path, name: str = "single_lift_thing", *, mirrored: bool = True, self_collision: bool = False) -> Released:
    """Write the case `name` and its results below `root`; points are lifted with W - c_x (`mirrored`) or c_x."""
    folder = write_case(root, name, frames=FRAMES, points=POINTS, surface=8, interior=4, tracks=4)
    case = Released(root=root, name=name)
    write_cameras(case)
    write_raw(case, mirrored)
    data = stored(folder)
    nodes = np.concatenate([data["object_points"][0], data["surface_points"], data["interior_points"]]).astype(np.float32)
    write_parameters(case)
    twin = write_checkpoint(case, nodes, data["controller_points"][0].astype(np.float32), self_collision)
    write_prediction(case, twin, DRAG // 1, DASHPOT // 1)
    write_pictures(case, nodes)
    return case


def poses() -> list[np.ndarray]:
    """Camera-to-world matrices of three cameras above the table (z = 0, up is -z), looking down."""
    matrices = []
    for k, angle in enumerate((0.0, 5.0, -6.0)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        pose[:3, 3] = [-0.035 * angle / 5, 0.004 * k, -0.5]
        matrices.append(pose)
    return matrices


def intrinsics(camera: int) -> np.ndarray:
    """K of a camera."""
    cx, cy = CENTERS[camera]
    return np.array([[FOCAL, 0.0, cx], [0.0, FOCAL, cy], [0.0, 0.0, 1.0]])


def write_cameras(case: Released, shift: float = 0.0) -> None:
    """metadata.json and calibrate.pkl; `shift` spoils c_x, pixels."""
    matrices = [intrinsics(camera) for camera in range(3)]
    for matrix in matrices:
        matrix[0, 2] += shift
    metadata = {"intrinsics": [m.tolist() for m in matrices], "fps": 30, "WH": [WIDTH, HEIGHT], "frame_num": FRAMES}
    write_json(case.folder / "metadata.json", metadata)
    dump(case.folder / "calibrate.pkl", poses())


def write_raw(case: Released, mirrored: bool) -> None:
    """Tracks and depth of frame 0; object points, surface, interior and controllers are made anew around their lift."""
    rng = np.random.default_rng(2)
    lifted = []
    for camera, pose in enumerate(poses()):
        depth = np.where(rng.uniform(size=(HEIGHT, WIDTH)) < 0.1, 0, rng.integers(390, 411, (HEIGHT, WIDTH))).astype(np.uint16)
        column, row = (axis.ravel() for axis in np.meshgrid(np.arange(26, 38), np.arange(18, 30)))
        visible = rng.uniform(size=len(row)) < 0.8
        # Released tracks are not whole pixels, and some lie outside the image.
        tracks = np.stack([row, column], axis=1) + rng.uniform(-0.4, 0.4, (len(row), 2))
        tracks = np.concatenate([tracks, [[-3.0, 5.0], [5.0, WIDTH + 2.0]]]).astype(np.float32)
        path = case.pixel_tracks(str(camera))
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, tracks=np.stack([tracks] * 2), visibility=np.append(visible, [True, True])[None].repeat(2, axis=0))
        case.first_depth(str(camera)).parent.mkdir(parents=True)
        np.save(case.first_depth(str(camera)), depth)
        z = depth[row, column] / 1000
        center = WIDTH - CENTERS[camera][0] if mirrored else CENTERS[camera][0]
        local = np.stack([z * (column - center) / FOCAL, z * (row - CENTERS[camera][1]) / FOCAL, z], axis=1)
        lifted.append((local @ pose[:3, :3].T + pose[:3, 3])[visible & (z > 0)])
    choice = rng.choice(sum(map(len, lifted)), POINTS, replace=False)
    rest = np.unique(np.concatenate(lifted)[choice], axis=0)
    assert len(rest) == POINTS
    data = stored(case.folder)
    motion = np.linspace(0, 1, FRAMES)[:, None] ** 2 * np.array([0.03, 0.01, -0.04])
    points = np.where(data["object_visibilities"][..., None], rest + motion[:, None], 0.0)
    inner = {
        key: rest[:size] + rng.uniform(0.002, 0.006, (size, 3)) for key, size in (("surface_points", 8), ("interior_points", 4))
    }
    hands = rest[rng.integers(POINTS // 3, size=30)] + rng.uniform(0.003, 0.006, (30, 3))
    edit(case.folder, object_points=points, controller_points=hands + motion[:, None], **inner)
    dump(case.folder / "gt_track_3d.pkl", np.where(points[:, :4] == 0, np.nan, points[:, :4]))


def parameters() -> dict[str, Any]:
    """What optimal_params.pkl holds."""
    return {
        "global_spring_Y": np.float64(3e3),
        "object_radius": np.float64(0.025),
        "object_max_neighbours": 12,
        "controller_radius": np.float64(0.03),
        "controller_max_neighbours": 8,
        "collide_elas": np.float32(0.5),
        "collide_fric": np.float32(0.3),
        "collide_object_elas": np.float32(0.7),
        "collide_object_fric": np.float32(0.3),
        "collision_dist": np.float64(0.012),
        "drag_damping": np.float64(DRAG),
        "dashpot_damping": np.float32(DASHPOT),
    }


def write_parameters(case: Released, **changes: Any) -> None:
    """optimal_params.pkl."""
    dump(case.parameters, parameters() | changes)


def write_checkpoint(case: Released, nodes: np.ndarray, hands: np.ndarray, self_collision: bool) -> Twin:
    """best_199.pth, scalars beyond their clamps among it; the twin, whose scalars are clamped."""
    p = parameters()
    sizes = [p[f"{who}_{what}"] for who in ("object", "controller") for what in ("radius", "max_neighbours")]
    topology = uniform_topology(nodes, hands, *sizes)
    stiffness = np.random.default_rng(3).uniform(1e3, 5e3, len(topology.springs)).astype(np.float32)
    stiffness[0] = 1.2e5
    scalars = {"collide_elas": -0.01, "collide_fric": 2.01, "collide_object_elas": 0.4, "collide_object_fric": 0.2}
    tensors = {name: torch.tensor([value]) for name, value in scalars.items()} | {"spring_Y": torch.tensor(stiffness)}
    path = case.root / "experiments" / case.name / "train" / "best_199.pth"
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"epoch": 199, "num_object_springs": topology.object_spring_count, **tensors}, path)
    material = Material(
        stiffness=stiffness.clip(0, 1e5),
        dashpot=np.full(len(stiffness), DASHPOT),
        drag=DRAG,
        ground_elasticity=0.0,
        ground_friction=2.0,
        contact_elasticity=0.4,
        contact_friction=0.2,
        contact_distance=0.012,
    )
    frame = Simulation(frame_time=667 * 5e-5, substeps=667, up="-z", self_collision=self_collision)
    return Twin(topology=topology, material=material, simulation=frame)


def write_prediction(case: Released, twin: Twin, drag: float, dashpot: float) -> np.ndarray:
    """inference.pkl, by the float64 reference; returns the positions."""
    material = replace(twin.material, drag=drag, dashpot=np.full(len(twin.topology.springs), dashpot))
    scene, start = ReferenceTwin.of(replace(twin, material=material)), twin.topology.nodes
    hands = stored(case.folder)["controller_points"].astype(np.float32)
    positions = simulation.rollout(scene, start, np.zeros_like(start), hands)[0].astype(np.float32)
    dump(case.prediction, positions)
    return positions


def write_pictures(case: Released, nodes: np.ndarray) -> None:
    """One splat per node, and what cameras and evaluation saw: the moved splats, other colors in part, masks shifted."""
    rng = np.random.default_rng(4)
    path = case.root / "gaussian_output" / case.name / SPLATS
    colors = rng.uniform(0.2, 0.9, (len(nodes), 3)).astype(np.float32)
    harmonics = np.zeros((len(nodes), 16, 3), np.float32)
    harmonics[:, 0] = (colors - 0.5) / C0
    opacity = np.where(np.arange(len(nodes)) % 9 == 0, -3.0, 2.0).astype(np.float32)
    turned = np.tile(np.array([[1, 0, 0, 0]], np.float32), (len(nodes), 1))
    scales = np.full((len(nodes), 1), np.log(0.006), np.float32)
    Splats(means=nodes, quaternions=turned, log_scales=scales, opacity_logits=opacity, harmonics=harmonics).save(path)
    for frame, rgba in enumerate(drawn(case)):
        observed = rgba[..., :3].copy()
        observed[:, ::2] = np.clip(observed[:, ::2].astype(int) + 25, 0, 255)
        mask = 255 * (np.roll(rgba[..., 3], 1, axis=0) > 100).astype(np.uint8)
        human = np.zeros_like(mask)
        human[:, HUMAN_COLUMNS] = 255
        for target, image in ((case.object_masks.parents[1] / "color" / "0", observed[..., ::-1]), (case.object_masks, mask)):
            write_png(target / f"{frame}.png", image)
        write_png(case.human_masks / f"{frame}.png", human)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write bytes as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def drawn(case: Released) -> list[np.ndarray]:
    """RGBA [H, W, 4] uint8 of every frame: camera 0 with the intrinsics of camera 1, faint splats left out."""
    splats = Splats.load(next((case.root / "gaussian_output" / case.name).rglob("*.ply")))
    opaque = splats.opacity_logits > np.log(0.1 / 0.9)
    view = View(torch.tensor(np.linalg.inv(poses()[0])), torch.tensor(intrinsics(1)), WIDTH, HEIGHT)
    positions = positions_of(case)
    colors = torch.tensor(0.5 + C0 * splats.harmonics[opaque, 0], dtype=torch.float64).clamp_min(0)
    opacity = torch.sigmoid(torch.tensor(splats.opacity_logits[opaque], dtype=torch.float64))
    scales = torch.exp(torch.tensor(splats.log_scales[opaque], dtype=torch.float64)).expand(-1, 3)
    skin, pictures = Skin(positions[0], released_degeneracy=True), []
    for means, turned in skin.carry(positions, torch.tensor(splats.means[opaque]), torch.tensor(splats.quaternions[opaque])):
        rgb, alpha, _ = reference(means.double(), turned.double(), scales, opacity, colors, view)
        picture = torch.cat([rgb, alpha[..., None]], dim=2).clamp(0, 1)
        pictures.append((255 * picture + 0.5).floor().to(torch.uint8).numpy())
    return pictures


def published_of(case: Released) -> Published:
    """Its scores, and as means over the one scenario."""
    per_frame = {**distances(case), **picture_scores(case)}
    lines = ["scenario,split,metric,value"]
    for name in (case.name, "MEAN22_REEVAL"):
        for split, frames in SPLITS.items():
            lines += [f"{name},{split},{metric},{np.mean([values[t] for t in frames]):.9f}" for metric, values in per_frame.items()]
    return Published(scores=released_scores(csv.DictReader(lines)), scenarios=frozenset({case.name}))


def distances(case: Released) -> dict[str, list[float]]:
    """Chamfer distance (L1) and track error per frame."""
    data, positions = stored(case.folder), positions_of(case)
    surface = data["object_points"].shape[1] + len(data["surface_points"])
    tracks = load_pickle(case.folder / "gt_track_3d.pkl")
    index = [int(np.argmin(np.linalg.norm(positions[0] - point, axis=1))) for point in tracks[0]]
    chamfer, error = [], []
    for t, nodes in enumerate(positions.astype(float)):
        seen = data["object_points"][t][data["object_visibilities"][t]]
        chamfer.append(np.mean([np.abs(nodes[:surface] - point).sum(axis=1).min() for point in seen]))
        there = ~np.isnan(tracks[t]).any(axis=1)
        error.append(np.linalg.norm(nodes[index] - tracks[t], axis=1)[there].mean() if there.any() else 0.0)
    return {"chamfer_distance_m": chamfer, "track_error_m": error}


def picture_scores(case: Released) -> dict[str, list[float]]:
    """PSNR and IoU per frame."""
    scores: dict[str, list[float]] = {"psnr": [], "iou": []}
    for t, rgba in enumerate(drawn(case)):
        observed = cv2.imread(str(case.colors / f"{t}.png"))[..., ::-1] / 255
        mask, human = (cv2.imread(str(f / f"{t}.png"), cv2.IMREAD_GRAYSCALE) / 255 for f in (case.object_masks, case.human_masks))
        shown = (1 - human)[..., None]
        error = observed * mask[..., None] * shown - rgba[..., :3] / 255 * shown
        scores["psnr"].append(20 * np.log10(1 / np.sqrt((error**2).mean())))
        alpha = rgba[..., 3] * (1 - human)
        scores["iou"].append(((mask > 0) & (alpha > 0)).sum() / ((mask > 0) | (alpha > 0)).sum())
    return scores


def positions_of(case: Released) -> np.ndarray:
    """inference.pkl."""
    positions: np.ndarray = load_pickle(case.prediction)
    return positions
