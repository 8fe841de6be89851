"""A small desk by arithmetic alone, for tests of intake: a table, a ball on it, seen by cameras; written as a camera's files."""

import json

import av
import cv2
import numpy as np

from neuspring.data.camera import Camera

SIZE = (80, 60)
K = np.array([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]])
EYES = ((0.05, -0.5, 0.35), (0.45, 0.2, 0.4))
TARGET = np.array([0.05, 0.05, 0.0])
RADIUS = 0.05
FRAMES = 7


def looking(eye, target, upright=(0, 0, 1)):
    """Camera to world [4, 4] with z towards the target and y as far down as can be."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, upright)
    pose = np.eye(4)
    pose[:3, 0] = x / np.linalg.norm(x)
    pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(z, pose[:3, 0]), z, eye
    return pose


def camera(index=0, name=""):
    """One of the cameras around the desk."""
    return Camera(name or str(index), *SIZE, K, looking(np.array(EYES[index]), TARGET))


def seen(view, frame=0, noise=0.0005):
    """RGB [H, W, 3] and depth [H, W], m: the table z = 0 with squares, and a red ball that moves along x by 5 mm per frame."""
    y, x = np.mgrid[: view.height, : view.width]
    ones = np.ones(x.shape)
    eye = view.camera_to_world[:3, 3]
    rays = view.lift(np.stack([x, y], axis=-1).astype(float), ones) - eye
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], 0.0)
    depth[depth > 3.0] = 0.0
    floor = eye + rays * depth[..., None]
    tone = np.where((np.floor(floor[..., 0] / 0.05) + np.floor(floor[..., 1] / 0.05)) % 2 == 0, 210, 150)
    color = np.repeat(tone[..., None], 3, axis=2).astype(np.uint8)
    offset = eye - TARGET - np.array([0.005 * frame, 0, RADIUS])
    a, b, c = (rays**2).sum(axis=-1), (rays * offset).sum(axis=-1), offset @ offset - RADIUS**2
    inside = b * b - a * c
    hit = inside > 0
    ball = (-b - np.sqrt(np.maximum(inside, 0))) / a
    color[hit], depth[hit] = (200, 40, 40), ball[hit]
    rough = np.random.default_rng(frame).normal(size=depth.shape) * noise
    return color, np.where(depth > 0, depth + rough, 0.0)


def counts(depth, unit=0.001):
    """Depth, m, as 16-bit counts."""
    return np.round(depth / unit).astype(np.uint16)


def write_folders(root, cameras=1, frames=FRAMES, first=0, unit=0.001):
    """`color_K/frame_N.png` and `depth_K/frame_N.png` of each camera, numbers without leading zeros, and rig.json."""
    for index in range(cameras):
        for frame in range(frames):
            color, depth = seen(camera(index), frame)
            for kind, image in (("color", color[..., ::-1]), ("depth", counts(depth, unit))):
                path = root / f"{kind}_{index}" / f"frame_{first + frame}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), image)
    write_rig(root / "rig.json", cameras, depth_unit=unit)
    return root


LENS = {"width": SIZE[0], "height": SIZE[1], "fx": 70.0, "fy": 70.0, "cx": 39.5, "cy": 29.5, "distortion_model": "none"}
POSED = {"poses": "camera_to_world", "axes": "opencv", "up": "+z"}


def write_rig(path, count=1, motion=None, **changes):
    """User's statement of the cameras, in a world moved by `motion` [4, 4]; keys that are changed to None are left out."""
    poses = [(np.eye(4) if motion is None else motion) @ camera(index).camera_to_world for index in range(count)]
    rig = {"frame_rate": 30, "depth_unit": 0.001, **POSED, "cameras": [LENS | {"pose": pose.tolist()} for pose in poses]} | changes
    return write_json(path, {key: value for key, value in rig.items() if value is not None})


def write_json(path, value):
    """A JSON file."""
    path.write_text(json.dumps(value))
    return path


def write_video(path, images, codec, stored, rate=15, options=None, **context):
    """A video of RGB or 16-bit gray images by a codec and pixel format of FFmpeg, with options and values of its context."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        for name, value in context.items():
            setattr(stream.codec_context, name, value)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = stored
        for image in images:
            kind = "rgb24" if image.ndim == 3 else "gray16le"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=kind)))
        container.mux(stream.encode())
    return path
