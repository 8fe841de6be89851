"""Recordings that say more about their cameras than folders of images do.

- RealSense .bag files, through pyrealsense2, which is imported only here. Depth is aligned to color by it.
- PhysTwin's raw layout: images, calibration, and masks, tracks and split where they are there.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.data import phystwin
from neuspring.data.capture import Camera
from neuspring.data.intake.images import CameraFeed, Lens, Paired, open_images
from neuspring.data.phystwin import CALIBRATION, annotated, cameras_of, detections, labels_of, raw_findings, train_end_of
from neuspring.data.unpickle import load_pickle

MODULE = "pyrealsense2"
PATIENCE = 5000
"""ms until the next frames of a file; none within it: the file ends."""
MODELS = {"none": True, "brown_conrady": True, "modified_brown_conrady": False, "inverse_brown_conrady": False}
"""Whether OpenCV's coefficients (k1, k2, p1, p2, k3) mean the same."""


@dataclass(frozen=True, eq=False)
class Bag:
    """One camera's recording. Every pass plays the file once; the first counts its frames."""

    name: str
    path: Path
    pose: None = None

    @cached_property
    def _about(self) -> tuple[int, float, float, Lens, str]:
        """Pairs, frames per second, m per count, intrinsics, remark. Raises InputError."""
        count, lens, unit, rate, remark = 0, None, 0.0, 0.0, ""
        for profile, _, _ in self._play(True):
            if lens is None:
                stream = profile.get_stream(_library().stream.color)
                found = stream.as_video_stream_profile().get_intrinsics()
                model = str(found.model).rpartition(".")[2]
                coefficients = np.array(found.coeffs, dtype=float)
                if not coefficients.any() or MODELS.get(model, False):
                    distortion = coefficients
                else:
                    largest = f"largest coefficient {abs(coefficients).max():.3g}"
                    remark = f"{self.path}: distortion of the model {model} is not removed; {largest}"
                    distortion = np.zeros(0)
                matrix = np.array([[found.fx, 0, found.ppx], [0, found.fy, found.ppy], [0, 0, 1.0]])
                lens = Lens(matrix=matrix, distortion=distortion, size=(int(found.width), int(found.height)))
                unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
                rate = float(stream.fps())
            count += 1
        if lens is None:
            raise InputError(self.path, "pairs of color and depth are required", "none", "Record both streams.")
        return count, rate, unit, lens, remark

    @property
    def numbers(self) -> list[int]:
        """Places from 0."""
        return list(range(self._about[0]))

    @property
    def rate(self) -> float:
        """That of the color stream."""
        return self._about[1]

    @property
    def unit(self) -> float:
        """That of the depth sensor."""
        return self._about[2]

    @property
    def lens(self) -> Lens:
        """Of the color stream, to which depth is aligned."""
        return self._about[3]

    @property
    def remarks(self) -> list[str]:
        """See `CameraFeed`."""
        return [self._about[4]] if self._about[4] else []

    def read(self, places: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """See `CameraFeed`. Raises InputError where the file ends early."""
        wanted = list(places)
        for place, (_, color, depth) in enumerate(self._play(False)):
            if not wanted:
                return
            if place == wanted[0]:
                wanted.pop(0)
                yield color, depth
        if wanted:
            raise InputError(self.path, f"a pair {wanted[0]} is required", "the recording ends before it")

    def files(self, places: Sequence[int]) -> list[Path]:
        """The recording."""
        return [self.path]

    def _play(self, only_count: bool) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
        """Profile, RGB and aligned depth of every pair whose color is new; empty images where they are only counted."""
        library = _library()
        if not self.path.is_file():
            raise InputError(self.path, "a RealSense .bag file is required", "nothing there")
        pipeline, settings = library.pipeline(), library.config()
        settings.enable_device_from_file(str(self.path), repeat_playback=False)
        try:
            profile = pipeline.start(settings)
        except RuntimeError as error:
            raise InputError(self.path, "this file must be a RealSense recording", str(error)) from error
        try:
            profile.get_device().as_playback().set_real_time(False)
            align, last = library.align(library.stream.color), -1
            while True:
                there, frames = pipeline.try_wait_for_frames(PATIENCE)
                if not there:
                    return
                color, depth = frames.get_color_frame(), frames.get_depth_frame()
                if not color or not depth or color.get_frame_number() == last:
                    continue
                last = color.get_frame_number()
                if only_count:
                    yield profile, np.zeros(0), np.zeros(0)
                    continue
                frames = align.process(frames)
                yield profile, self._rgb(frames.get_color_frame()), np.array(frames.get_depth_frame().get_data())
        finally:
            pipeline.stop()

    def _rgb(self, frame: Any) -> np.ndarray:
        image, kind = np.array(frame.get_data()), str(frame.get_profile().format()).rpartition(".")[2]
        if kind == "rgb8":
            return image
        if kind == "bgr8":
            return image[..., ::-1]
        if kind == "yuyv":
            return np.asarray(cv2.cvtColor(image.view(np.uint8).reshape(*image.shape[:2], 2), cv2.COLOR_YUV2RGB_YUYV))
        raise InputError(self.path, "color must be rgb8, bgr8 or yuyv", kind)


def _library() -> Any:
    try:
        return importlib.import_module(MODULE)
    except ImportError as error:
        remedy = f"Run `pip install {MODULE}`, or export the recording to folders (rs-convert) and use --color and --depth."
        raise InputError("--bag", f"the package {MODULE} is required to read a .bag file", "not installed", remedy) from error


@dataclass(frozen=True, eq=False)
class Raw:
    """A case in PhysTwin's raw layout."""

    case: Path
    views: list[CameraFeed]
    cameras: dict[str, Camera]
    rate: float
    train_end: int | None
    """Of all its frames."""
    tracks: np.ndarray | None
    """[T, K, 3], m, in its world."""
    ids: dict[str, dict[int, list[str]]]
    """Detections of each label, by camera; empty without masks."""

    @classmethod
    def open(cls, case: Path) -> Raw:
        """Read its calibration. Raises InputError."""
        metadata, poses = load_json(case / phystwin.METADATA), load_pickle(case / CALIBRATION)
        refuse(raw_findings(case, metadata, poses))
        cameras = {camera.name: camera for camera in cameras_of(metadata, poses)}
        views: list[CameraFeed] = [
            Paired(
                name,
                open_images(case / "color" / name, "color"),
                open_images(case / "depth" / name, "depth"),
                unit=0.001,
                lens=Lens(matrix=camera.intrinsics, size=(camera.width, camera.height)),
                pose=camera.camera_to_world,
            )
            for name, camera in cameras.items()
        ]
        frames = int(metadata["frame_num"])
        return cls(
            case,
            views,
            cameras,
            float(metadata.get("fps", phystwin.RELEASED_FRAME_RATE)),
            train_end_of(case, frames),
            annotated(case, frames),
            {name: detections(case, name) for name in cameras} if (case / "mask").is_dir() else {},
        )

    def labels(self, camera: str, number: int) -> np.ndarray:
        """Mask [H, W] uint8 of a camera's frame with this number in its name. Raises InputError."""
        return labels_of(self.case, self.cameras[camera], number, self.ids[camera])
