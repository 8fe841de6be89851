"""Films are read back: number, size and time of frames, colors of the paper, the limit of their size, what is refused."""

import av
import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image

from neuspring.core.errors import InputError
from neuspring.draw.film import HOLD, film_pictures, write_film
from neuspring.draw.sheet import FUTURE, TRAINING
from tests.support.shown import painter

ALL = range(8)
RATE = 30.0
COLOR_DIFFERENCE = 12
"""Change by H.264 in a uniform area, of 255."""


def gif(path) -> tuple[list[np.ndarray], list[int], int]:
    """Pictures, times in ms, and how often it repeats (0: for ever)."""
    with Image.open(path) as found:
        pictures, times = [], []
        for frame in range(found.n_frames):
            found.seek(frame)
            pictures.append(np.asarray(found.convert("RGB")))
            times.append(found.info["duration"])
        return pictures, times, found.info["loop"]


def mp4(path) -> tuple[list[np.ndarray], float]:
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], rate


def test_a_gif_loops_keeps_the_time_and_holds_its_end(video, tmp_path):
    made = write_film(painter(video, ALL, style="splats", error="none"), tmp_path / "film.gif", 320)
    pictures, times, loop = gif(tmp_path / "film.gif")
    assert (len(pictures), loop, made.frames, made.width) == (8, 0, 8, 320)
    assert pictures[0].shape == (made.height, 320, 3)
    # 7 of 30 frames per second take 0.23 s, in hundredths.
    assert sum(times[:-1]) == pytest.approx(1000 * 7 / RATE, abs=10) and times[-1] == 1000 * HOLD
    assert (tmp_path / "film.gif").stat().st_size == made.bytes
    # Paper is white, and the bar of time has its two colors.
    assert all((picture[20:, 1] == 255).all() for picture in pictures)
    assert (
        np.abs(pictures[-1][2, 310].astype(int) - FUTURE).max() < 8
        and np.abs(pictures[-1][2, 120].astype(int) - TRAINING).max() < 8
    )
    assert np.abs(pictures[0][2, 310].astype(int) - FUTURE).max() > 50
    assert not any(name.name.startswith(".") for name in tmp_path.iterdir())
    assert not plt.get_fignums()


def test_an_mp4_has_all_frames_at_their_rate(video, tmp_path):
    paints = painter(video, ALL, style="splats", error="color")
    made = write_film(paints, tmp_path / "film.mp4", 400)
    pictures, rate = mp4(tmp_path / "film.mp4")
    assert (len(pictures), rate, made.rate) == (8, RATE, RATE)
    expected = list(film_pictures(paints, ALL, 400))
    assert pictures[0].shape == expected[0].shape and expected[0].shape[1] == 400
    difference = np.abs(pictures[3].astype(int) - expected[3])
    assert np.median(difference) <= 2 and np.quantile(difference, 0.9) < COLOR_DIFFERENCE


def test_a_film_that_is_too_large_is_made_coarser_or_refused(video, tmp_path):
    paints = painter(video, (0, 3, 7), style="splats", error="none")
    whole = write_film(paints, tmp_path / "whole.gif", 240)
    limit = 0.6 * whole.bytes / 1e6
    small = write_film(paints, tmp_path / "small.gif", 240, megabytes=limit)
    assert small.bytes <= 1e6 * limit and small.coarser and not whole.coarser and "coarser" in str(small)
    assert len(gif(tmp_path / "small.gif")[0]) == small.frames
    with pytest.raises(InputError, match=r"the size of the smallest video.* Reduce --frames or --methods, or write \.mp4"):
        write_film(paints, tmp_path / "none.gif", 240, megabytes=1e-5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.gif", "whole.gif"]


def test_a_scene_without_video_is_filmed_as_points(plain):
    pictures = list(film_pictures(painter(plain, (0, 4, 7)), (0, 4, 7), 300))
    assert len(pictures) == 3 and all(side % 2 == 0 for side in pictures[0].shape[:2])
    blue = (np.abs(pictures[0].astype(int) - [31, 119, 180]).max(axis=2) < 30)[40:, :100]
    assert blue.any()
