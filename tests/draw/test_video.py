"""Videos are read back: images, size, frame rate, colors; errors."""

import struct
from pathlib import Path

import av
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.draw.video import Video


def write_video(path: Path, frames, rate: float, quality: int = 20):
    with Video(path, rate, quality) as video:
        for frame in frames:
            video.add(frame)


def moving_square(height: int = 48, width: int = 64, count: int = 12) -> list[np.ndarray]:
    """A square that moves to the right on a colored ramp."""
    ramp = np.linspace(40, 200, width)[None, :, None] * np.array([1.0, 0.6, 0.3])
    frames = []
    for k in range(count):
        frame = np.broadcast_to(ramp, (height, width, 3)).astype(np.uint8)
        frame[12:28, 4 + 2 * k : 20 + 2 * k] = (30, 60, 220)
        frames.append(frame)
    return frames


def read(path: Path) -> tuple[list[np.ndarray], av.VideoStream]:
    with av.open(path) as container:
        stream = container.streams.video[0]
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)], stream


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.square(a.astype(float) - b).mean()))


def test_a_video_is_read_back(tmp_path):
    path, frames = tmp_path / "new" / "square.mp4", moving_square()
    write_video(path, iter(frames), 30)
    found, stream = read(path)
    assert len(found) == 12
    assert stream.average_rate == 30
    assert (stream.codec.name, stream.pix_fmt) == ("h264", "yuv420p")
    assert found[0].shape == (48, 64, 3)
    assert min(psnr(*pair) for pair in zip(found, frames, strict=True)) > 30
    assert [entry.name for entry in path.parent.iterdir()] == ["square.mp4"]


def test_colors_are_kept(tmp_path):
    """A wrong matrix or range shifts saturated colors by ten levels and more."""
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (200, 30, 120)]
    frames = [np.full((32, 32, 3), color, np.uint8) for color in colors]
    write_video(tmp_path / "colors.mp4", frames, 5, quality=4)
    with av.open(tmp_path / "colors.mp4") as container:
        stored = list(container.decode(video=0))
    for frame, color in zip(stored, colors, strict=True):
        assert (frame.colorspace, frame.color_range) == (1, 1)
        assert np.abs(frame.to_ndarray(format="rgb24").astype(int) - color).max() <= 4


@pytest.mark.parametrize(("height", "width"), [(47, 63), (48, 63), (47, 64), (1, 1)])
def test_an_odd_size_grows_by_one_pixel(tmp_path, height, width):
    frames = moving_square()
    frames = [frame[:height, :width] for frame in frames]
    write_video(tmp_path / "odd.mp4", frames, 30)
    found, _ = read(tmp_path / "odd.mp4")
    assert len(found) == 12
    assert found[0].shape == (height + height % 2, width + width % 2, 3)
    padded = [np.pad(f, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") for f in frames]
    assert min(psnr(*pair) for pair in zip(found, padded, strict=True)) > 30


def test_the_index_comes_before_the_pictures(tmp_path):
    write_video(tmp_path / "fast.mp4", moving_square(), 30)
    content, at, boxes = (tmp_path / "fast.mp4").read_bytes(), 0, []
    while at < len(content):
        size, kind = struct.unpack(">I4s", content[at : at + 8])
        boxes.append(kind)
        at += size
    assert boxes.index(b"moov") < boxes.index(b"mdat")


@pytest.mark.parametrize(
    ("frames", "rule"),
    [
        ([], "at least one image"),
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)], "image 1 .* the shape of the first"),
        ([np.zeros((4, 4, 3), np.float32)], "image 0 .* uint8"),
    ],
)
def test_bad_pictures_are_refused(tmp_path, frames, rule):
    path = tmp_path / "bad.mp4"
    path.write_bytes(b"older video")
    with pytest.raises(InputError, match=rule) as raised:
        write_video(path, frames, 30)
    assert str(path) in str(raised.value)
    assert path.read_bytes() == b"older video"
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.mp4"]
