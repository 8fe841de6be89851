"""A stand-in for pyrealsense2 with the part of its interface that reading a file uses: no recording of a camera is at hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np


class Picture:
    """A video frame."""

    def __init__(self, image: np.ndarray, number: int, kind: str) -> None:
        self._image, self._number, self._kind = image, number, kind

    def get_data(self) -> np.ndarray:
        return self._image

    def get_frame_number(self) -> int:
        return self._number

    def get_profile(self) -> SimpleNamespace:
        return SimpleNamespace(format=lambda: f"format.{self._kind}")


class Pair:
    """A composite frame; `aligned` as rs.align returns it."""

    def __init__(self, color: Picture, depth: np.ndarray, aligned: bool = False) -> None:
        self._color, self._depth, self.aligned = color, depth, aligned

    def get_color_frame(self) -> Picture:
        return self._color

    def get_depth_frame(self) -> Picture:
        return Picture(self._depth if self.aligned else np.zeros((4, 4), np.uint16), self._color.get_frame_number(), "z16")


def module(
    colors: list[np.ndarray],
    depths: list[np.ndarray],
    *,
    intrinsics: dict[str, object],
    model: str = "inverse_brown_conrady",
    kind: str = "rgb8",
    scale: float = 0.001,
    rate: int = 30,
    repeated: bool = False,
) -> SimpleNamespace:
    """The module. With `repeated` each color frame comes twice, as it does where depth has twice the rate of color."""
    frames = [Pair(Picture(color, number, kind), depth) for number, (color, depth) in enumerate(zip(colors, depths, strict=True))]
    frames = [frame for frame in frames for _ in range(2 if repeated else 1)]
    about = SimpleNamespace(model=f"distortion.{model}", **intrinsics)
    stream = SimpleNamespace(fps=lambda: rate, as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: about))
    playback = SimpleNamespace(set_real_time=lambda value: None)
    device = SimpleNamespace(
        as_playback=lambda: playback, first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: scale)
    )

    class Pipeline:
        def start(self, settings: SimpleNamespace) -> SimpleNamespace:
            if not settings.path.endswith(".bag"):
                raise RuntimeError("Failed to resolve request")
            self._left = iter(frames)
            return SimpleNamespace(get_stream=lambda which: stream, get_device=lambda: device)

        def try_wait_for_frames(self, patience: int) -> tuple[bool, Pair | None]:
            frame = next(self._left, None)
            return frame is not None, frame

        def stop(self) -> None:
            pass

    def config() -> SimpleNamespace:
        settings = SimpleNamespace(path="")
        settings.enable_device_from_file = lambda path, repeat_playback: setattr(settings, "path", path)
        return settings

    def align(which: str) -> SimpleNamespace:
        return SimpleNamespace(process=lambda pair: Pair(pair.get_color_frame(), pair._depth, aligned=True))

    return SimpleNamespace(pipeline=Pipeline, config=config, align=align, stream=SimpleNamespace(color="color"))
