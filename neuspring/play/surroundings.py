"""What was observed: points, annotated tracks, and cameras with their images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.play.body import spacing

if TYPE_CHECKING:
    import viser

SEEN, TRACK, CAMERA = (0, 150, 90), (150, 0, 200), (60, 60, 60)
FRUSTUM = 0.12
"""Length of a camera's pyramid as a part of the scene's size."""
WIDEST = 480
"""Pixels: larger images are made smaller before they are sent."""


class Surroundings:
    """Points, tracks and cameras of one scenario in the scene."""

    def __init__(self, scene: viser.SceneApi, observations: Observations, capture: Capture | None, size: float) -> None:
        self._seen, self._capture = observations, capture
        radius = min(0.35 * spacing(observations.object_points[0]), 0.006 * size)
        points = self._points(0)
        self.points = scene.add_point_cloud(
            "/observed/points", points, np.array(SEEN, np.uint8), point_size=radius, point_shape="circle", precision="float32"
        )
        self.tracks = scene.add_point_cloud(
            "/observed/tracks", self._tracks(0), np.array(TRACK, np.uint8), point_size=1.4 * radius, point_shape="diamond",
            precision="float32",
        )  # fmt: skip
        self._images = False
        self.cameras: dict[str, Any] = {}
        for name, camera in (capture.cameras if capture else {}).items():
            turn = Rotation.from_matrix(camera.camera_to_world[:3, :3]).as_quat(scalar_first=True)
            self.cameras[name] = scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=float(2 * np.arctan2(camera.height / 2, camera.intrinsics[1, 1])),
                aspect=camera.width / camera.height,
                scale=FRUSTUM * size,
                color=CAMERA,
                thickness=1.5,
                thickness_units="screen",
                wxyz=turn,
                position=camera.camera_to_world[:3, 3],
            )

    def show(self, *, points: bool, tracks: bool, cameras: bool, images: bool) -> None:
        """Which parts are seen."""
        self.points.visible, self.tracks.visible = points, tracks
        for camera in self.cameras.values():
            camera.visible = cameras
            if not (images and cameras) and self._images:
                camera.image = None
        self._images = images and cameras

    def move(self, frame: int) -> None:
        """Show a frame."""
        if self.points.visible:
            self.points.points = self._points(frame)
        if self.tracks.visible:
            self.tracks.points = self._tracks(frame)
        if self._images:
            for name, camera in self.cameras.items():
                camera.image = self._image(name, frame)

    def _points(self, frame: int) -> np.ndarray:
        return np.asarray(self._seen.object_points[frame][self._seen.object_visibility[frame]])

    def _tracks(self, frame: int) -> np.ndarray:
        tracks = self._seen.tracks[frame] if len(self._seen.tracks) else np.zeros((0, 3), np.float32)
        return np.asarray(tracks[np.isfinite(tracks).all(axis=1)])

    def _image(self, name: str, frame: int) -> np.ndarray | None:
        """A small picture, or none where the camera has none."""
        assert self._capture is not None
        if frame >= self._capture.frame_count or not self._capture.has(name, frame):
            return None
        try:
            image = self._capture.color(name, frame)
        except InputError:
            return None
        factor = WIDEST / max(image.shape[:2])
        return image if factor >= 1 else cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
