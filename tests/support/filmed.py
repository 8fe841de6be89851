"""A small film with known motion for tests: a body and a hand's ball above it move together, seen by cameras around them."""

import hashlib
import json
import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
import trimesh

from neuspring.data.camera import CameraEntry
from neuspring.data.capture import HANDS, NOTHING, OBJECT, Capture, Writer
from neuspring.scenes.render import SKIN_COLOR, Part, Renderer, looking, quantized
from neuspring.scenes.shapes import capsule, smooth_union, sphere, surface
from tests.support.captures import describe
from tests.support.phystwin_case import dump, write_json

FRAMES = 6
STEP = np.array([0.004, 0.002, 0.006])
"""m per frame."""
BODY = smooth_union([sphere((0, 0, 0.06), 0.05), capsule((0, 0, 0.06), (0.1, 0, 0.04), 0.03)], 0.005)
HAND_PLACE = np.array([-0.02, 0.0, 0.145])
EYES = ((0.45, -0.35, 0.4), (-0.2, 0.55, 0.4), (-0.4, -0.4, 0.45))
TURNED = 20.0
SIZE = (160, 90)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a world with z up to one with z down, as PhysTwin's."""


def intrinsics(size):
    focal = 0.85 * size[0]
    return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])


KEPT = tempfile.TemporaryDirectory(prefix="neuspring-films-")


def film(folder, **options):
    """The capture that `rendered` makes. Each film is rendered once per process; later calls copy its folder."""
    kept = Path(KEPT.name) / hashlib.sha256(repr(sorted(options.items())).encode()).hexdigest()[:16]
    if not kept.exists():
        rendered(kept, **options)
    shutil.copytree(kept, folder, dirs_exist_ok=True)
    return Capture.load(folder)


def rendered(
    folder,
    cameras=3,
    sizes=(SIZE, SIZE, SIZE),
    missing=None,
    up="+z",
    stand=0.0,
    **changes,
):
    """A capture with masks; `missing` frames by camera. Annotated tracks: twenty vertices of the body.

    The body begins on a box that is `stand` m high, turned by TURNED degrees.
    """
    missing = missing or {}
    vertices, faces = surface(BODY, (-0.08, -0.08, -0.01), (0.15, 0.08, 0.13), 0.004)
    ball, ball_faces = surface(sphere((0, 0, 0), 0.032), (-0.04,) * 3, (0.04,) * 3, 0.004)
    colors = np.where(np.sin(90 * vertices[:, :1] + 60 * vertices[:, 1:2]) > 0, [0.15, 0.3, 0.65], [0.3, 0.55, 0.3])
    parts = [
        Part(vertices, faces, colors, OBJECT, (60.0, 0.8)),
        Part(ball, ball_faces, np.tile(SKIN_COLOR, (len(ball), 1)), HANDS, (45.0, 0.6)),
    ]
    fixed = []
    if stand:
        box = trimesh.creation.box((0.26, 0.2, stand), trimesh.transformations.rotation_matrix(np.radians(TURNED), (0, 0, 1)))
        fixed = [box.vertices + np.array([0.03, 0, stand / 2])]
        parts.append(Part(fixed[0], np.asarray(box.faces), np.tile((0.4, 0.4, 0.4), (8, 1)), NOTHING, (60.0, 0.0)))
    renderer = Renderer(parts)
    turn = FLIP if up == "-z" else np.eye(4)
    poses = [looking(np.array(eye), np.array([0.03, 0, 0.08])) for eye in EYES[:cameras]]
    entries = tuple(
        CameraEntry(
            name=str(k),
            width=size[0],
            height=size[1],
            intrinsics=rows(intrinsics(size)),
            camera_to_world=rows(turn @ pose),
            missing=missing.get(k, ()),
        )
        for k, (pose, size) in enumerate(zip(poses, sizes, strict=False))
    )
    plain = {"name": "film", "category": "toy", "frame_count": FRAMES, "cameras": entries, "up": up}
    writer = Writer(folder, describe(**(plain | changes)))
    upright = {entry.name: (entry, pose) for entry, pose in zip(entries, poses, strict=True)}
    for frame in range(FRAMES):
        rise = frame * STEP + np.array([0, 0, stand])
        renderer.move([vertices + rise, ball + HAND_PLACE + rise, *fixed])
        for name, camera in writer.capture.cameras.items():
            entry, pose = upright[name]
            if frame not in entry.missing:
                view = renderer.render(type(camera)(name, camera.width, camera.height, camera.intrinsics, pose))
                writer.frame(name, frame, view.color, quantized(view.depth, 0.001), view.label)
    annotated = vertices[:: len(vertices) // 20]
    return writer.finish((annotated + np.arange(FRAMES)[:, None, None] * STEP) @ turn[:3, :3].T)


def write_raw(capture, case):
    """The capture in PhysTwin's raw layout: one mask per detection, depth as npy in millimeters, poses as a pickle."""
    case.mkdir(parents=True)
    first = next(iter(capture.cameras.values()))
    metadata = {
        "intrinsics": [camera.intrinsics.tolist() for camera in capture.cameras.values()],
        "WH": [first.width, first.height],
        "frame_num": capture.frame_count,
        "fps": 30,
    }
    write_json(case / "metadata.json", metadata)
    dump(case / "calibrate.pkl", [camera.camera_to_world for camera in capture.cameras.values()])
    write_json(case / "split.json", {"frame_len": capture.frame_count, "train": [0, 4], "test": [4, capture.frame_count]})
    dump(case / "gt_track_3d.pkl", capture.tracks())
    for name in capture.cameras:
        (case / "mask").mkdir(exist_ok=True)
        (case / "mask" / f"mask_info_{name}.json").write_text(json.dumps({"0": "toy", "1": "hand"}))
        for frame in range(capture.frame_count):
            for kind in ("color", "depth"):
                (case / kind / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(case / "color" / name / f"{frame}.png"), capture.color(name, frame)[..., ::-1])
            np.save(case / "depth" / name / f"{frame}.npy", np.round(1000 * capture.depth(name, frame)).astype(np.uint16))
            for detection, label in (("0", OBJECT), ("1", HANDS)):
                path = case / "mask" / name / detection / f"{frame}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), np.where(capture.mask(name, frame) == label, 255, 0).astype(np.uint8))
    return case


def rows(matrix):
    return tuple(tuple(map(float, row)) for row in matrix)
