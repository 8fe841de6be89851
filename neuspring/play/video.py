"""A recorded interaction as a video: the twin moves again under its controls, drawn as splats, else as nodes and springs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from neuspring.config.images import Images
from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.data.capture import Camera
from neuspring.play.colors import OVER, Springs, strain_scale
from neuspring.play.controls import Controls, replay
from neuspring.play.live import TOO_MUCH
from neuspring.play.results import Run, Scene
from neuspring.report.draw.sheet import sample
from neuspring.report.draw.twin import Lines
from neuspring.report.video import Video
from neuspring.splats.draw import WHITE, picture, view_of
from neuspring.splats.model import Gaussians
from neuspring.splats.rasterize import choose_backend
from neuspring.splats.skinning import Skin

WIDTH, HEIGHT, OPENING = 960, 720, math.radians(45)
"""Pixels, and the vertical angle of view, of a video from no camera of the capture."""
NODE, HAND, GRABBED, DARK = (70, 90, 120), (214, 39, 40), (255, 160, 0), (40, 40, 40)
SUBPIXEL = 4
"""Bits behind the point of places in pixels."""


@dataclass(frozen=True)
class WrittenVideo:
    """What was written."""

    path: Path
    frames: int
    kind: str
    """splats, or nodes and springs."""
    reason: str = ""
    """Why it is shorter than the recording, or has no splats."""


def write_video(found: Scene, run: Run, controls: Controls, path: Path, camera: str | None = None) -> WrittenVideo:
    """A video of the controls on a run's twin, from the view of the page or of a camera. Raises InputError."""
    assert run.twin is not None
    view = _camera(found, run.twin, camera)
    motion = replay(run.twin, controls)
    reason, splats = motion.reason, None
    try:
        splats = None if "centers" in run.paths else run.splats
    except (InputError, NumericalFailure) as error:
        reason = f"no splats: {error}"
    x = motion.positions
    start = controls.start.hands if controls.start.hands.size else run.twin.topology.controllers
    hands = np.concatenate([start[None], controls.hands])
    drawn = _points(run.twin, x, hands, view) if splats is None else _splats(Gaussians.of(splats), run.twin, x, view)
    parts = Springs.of(run.twin)
    rate = 1 / run.twin.simulation.frame_time
    with Video(path, rate) as video:
        for frame, image in enumerate(drawn):
            strain = float(parts.strain(parts.ends(x[frame], hands[frame])).max(initial=0.0))
            _mark(image, view, controls, x[frame], hands[frame], frame)
            _caption(image, f"{run.name}  {frame / rate:.2f} s", strain)
            video.add(image)
    return WrittenVideo(path, len(x), "splats" if splats is not None else "nodes and springs", reason)


def _camera(found: Scene, twin: Twin, name: str | None) -> Camera:
    """A camera of the capture, or one that sees the whole body from the side."""
    if name is not None:
        cameras = found.capture.cameras if found.capture else {}
        if name not in cameras:
            raise InputError("--camera", f"must be a camera of the capture: {', '.join(cameras) or 'there is none'}", name)
        return cameras[name]
    nodes, sign = twin.topology.nodes.astype(float), twin.simulation.up_sign
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    middle, size = 0.5 * (low + high), max(float(np.linalg.norm(high - low)), 0.05)
    z = -np.array([1.0, -0.35, 0.45 * sign])
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, sign])
    pose = np.eye(4)
    pose[:3, 0] = x / np.linalg.norm(x)
    pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(z, pose[:3, 0]), z, middle - 1.6 * size * z
    focal = 0.5 * HEIGHT / math.tan(OPENING / 2)
    return Camera("view", WIDTH, HEIGHT, np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]), pose)


def _splats(start: Gaussians, twin: Twin, positions: np.ndarray, camera: Camera) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] of the splats, which the nodes carry from the twin's frame 0."""
    view, backend = view_of(camera, Images(), "cpu"), choose_backend("auto", "cpu")
    skin = Skin(twin.topology.nodes, frozen=True)
    for nodes in positions:
        means, quaternions = skin.step(twin.topology.nodes, nodes, start.means, start.quaternions)
        moved = replace(start, means=means, quaternions=quaternions)
        yield np.ascontiguousarray(picture(moved, view, backend, WHITE)[..., :3])


def _points(twin: Twin, positions: np.ndarray, hands: np.ndarray, camera: Camera) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] of springs, colored by strain, and nodes."""
    parts, scale = Springs.of(twin, sample(len(Lines.of(twin).pairs))), strain_scale(TOO_MUCH)
    for nodes, held in zip(positions, hands, strict=False):
        image = np.full((camera.height, camera.width, 3), 255, np.uint8)
        ends = parts.ends(nodes, held)
        strain = parts.strain(ends)
        colors = scale.paint(strain)
        colors[strain > TOO_MUCH] = OVER
        pixels, depth = camera.project(ends.astype(float))
        # The farthest first, so that the nearest is on top.
        for spring in np.argsort(-depth.mean(axis=1)):
            if (depth[spring] > 0).all():
                first, second = (_fixed(place) for place in pixels[spring])
                cv2.line(image, first, second, colors[spring].tolist(), 2, cv2.LINE_AA, SUBPIXEL)
        for place in _in_front(camera, nodes):
            cv2.circle(image, _fixed(place), 3 << SUBPIXEL, NODE, -1, cv2.LINE_AA, SUBPIXEL)
        yield image


def _mark(image: np.ndarray, camera: Camera, controls: Controls, nodes: np.ndarray, hands: np.ndarray, frame: int) -> None:
    """Hands, and the pull on the grabbed node."""
    for place in _in_front(camera, hands):
        cv2.circle(image, _fixed(place), 4 << SUBPIXEL, HAND, -1, cv2.LINE_AA, SUBPIXEL)
    node = int(controls.grabbed[frame - 1]) if frame else -1
    if node >= 0:
        both = _in_front(camera, np.stack([nodes[node], controls.target[frame - 1]]))
        if len(both) == 2:
            cv2.line(image, _fixed(both[0]), _fixed(both[1]), GRABBED, 2, cv2.LINE_AA, SUBPIXEL)
            cv2.circle(image, _fixed(both[0]), 6 << SUBPIXEL, GRABBED, -1, cv2.LINE_AA, SUBPIXEL)


def _caption(image: np.ndarray, text: str, strain: float) -> None:
    """Who and when, and the largest strain, red where it is too much."""
    said = f"largest strain {strain:.2f}" + (f", above {TOO_MUCH:.2f}" if strain > TOO_MUCH else "")
    for line, (words, color) in enumerate(((text, DARK), (said, HAND if strain > TOO_MUCH else DARK))):
        cv2.putText(image, words, (14, 28 + 24 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.6, color, 1, cv2.LINE_AA)


def _in_front(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels [P, 2] of the points in front of the camera."""
    pixels, depth = camera.project(np.asarray(points, float))
    return np.asarray(pixels[depth > 0])


def _fixed(place: np.ndarray) -> tuple[int, int]:
    """Pixels with bits behind the point, as OpenCV draws; far outside is just outside."""
    x, y = np.clip(np.round(place * (1 << SUBPIXEL)), -(1 << 20), 1 << 20)
    return int(x), int(y)
