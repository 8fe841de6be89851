"""A RealSense .bag file, one per camera."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.formats import CaptureFormat, Pair, Recorded, picked
from neuspring.extensions.make_capture.moments import Series

MODULE = "pyrealsense2"
BAG_PATIENCE = 5000
"""ms until the next frames of a file; none within it: the file ends."""


class Bag:
    """One camera's recording in a RealSense file. Every pass plays the file once; the first, here, counts its frames."""

    pose = None

    def __init__(self, name: str, path: Path) -> None:
        """Raises InputError."""
        self.name, self.path = name, path
        count = 0
        for profile, _, _ in self._play(True):
            if not count:
                stream = profile.get_stream(_library().stream.color)
                self._rate = float(stream.fps())
                self.unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
                about = stream.as_video_stream_profile().get_intrinsics()
                coefficients, model = np.array(about.coeffs, dtype=float), str(about.model).rpartition(".")[2]
                matrix = np.array([[about.fx, 0, about.ppx], [0, about.fy, about.ppy], [0, 0, 1.0]])
                self.lens = Lens(matrix=matrix, distortion=coefficients, model=model, size=(int(about.width), int(about.height)))
            count += 1
        if not count:
            raise InputError(path, "pairs of color and depth are required", "none", "Record both streams.")
        self.series = Series(list(range(count)))

    def rate(self, places: Sequence[int]) -> float:
        """Frames per second that were set."""
        return self._rate

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """Color with depth that is aligned to it. Raises InputError where the file ends early."""
        return picked(self.path, ((color, depth) for _, color, depth in self._play(False)), places)

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
                there, frames = pipeline.try_wait_for_frames(BAG_PATIENCE)
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
                color, depth = frames.get_color_frame(), frames.get_depth_frame()
                image, kind = np.array(color.get_data()), str(color.get_profile().format()).rpartition(".")[2]
                if kind == "bgr8":
                    image = image[..., ::-1]
                elif kind == "yuyv":
                    image = cv2.cvtColor(image.view(np.uint8).reshape(*image.shape[:2], 2), cv2.COLOR_YUV2RGB_YUYV)
                elif kind != "rgb8":
                    raise InputError(self.path, "color must be rgb8, bgr8 or yuyv", kind)
                yield profile, image, np.array(depth.get_data())
        finally:
            pipeline.stop()


def _library() -> Any:
    try:
        return importlib.import_module(MODULE)
    except ImportError as error:
        remedy = f"Run `pip install {MODULE}`, or export the recording to folders (rs-convert) and use --color and --depth."
        raise InputError("--bag", f"the package {MODULE} is required to read a .bag file", "not installed", remedy) from error


def _recording(paths: Sequence[Path], cameras: Sequence[str]) -> Recorded:
    names = cameras or tuple(map(str, range(len(paths))))
    if len(set(names)) != len(paths):
        raise InputError("--cameras", f"{len(paths)} different names are required", " ".join(names))
    return Recorded(views=[Bag(camera, path) for camera, path in zip(names, paths, strict=True)])


capture_format = CaptureFormat(
    about="a RealSense .bag file", recognizes=lambda path: path.suffix.lower() == ".bag", recording=_recording
)
