"""Film strips: rows and columns, an error that is zero where prediction and observation agree, borders and captions."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib import pyplot as plt

from neuspring.draw.painter import DRAWN_MM, distances
from neuspring.draw.strip import rows_of, strip_figure
from neuspring.extensions.figures.drawing import caption
from neuspring.extensions.figures.filmed import FilmedScene, PhotoPainter
from tests.support.shown import METHODS, filmed, observed, painter

FRAMES = (0, 3, 5, 7)
EXACT = 1e-3
"""mm: the first method is the scene's own twin, simulated in single precision."""


def grid(figure, rows: int, columns: int) -> np.ndarray:
    """Panels [rows, columns], in the order of the picture."""
    panels = [axis for axis in figure.axes if axis.get_xlim()[0] == -0.5]
    assert len(panels) == rows * columns
    placed = sorted(panels, key=lambda axis: (-round(axis.get_position().y0, 4), axis.get_position().x0))
    return np.array(placed, object).reshape(rows, columns)


@pytest.mark.parametrize(("error", "rows"), [("distance", 5), ("none", 3)])
def test_a_row_for_what_was_observed_and_each_method_and_a_column_per_frame(plain, error, rows):
    paints = painter(plain, FRAMES, error=error)
    assert [which for _, which, _ in rows_of(paints)] == ([None, 0, 0, 1, 1] if rows == 5 else [None, 0, 1])
    figure = strip_figure(paints, 6.0)
    panels = grid(figure, rows, len(FRAMES))
    assert figure.get_figwidth() == pytest.approx(6.0)
    assert len({round(axis.get_position().x0, 6) for axis in panels.ravel()}) == len(FRAMES)
    # No panel leaves the page, and none lies over another.
    boxes = [axis.get_position() for axis in panels.ravel()]
    assert all(min(box.x0, box.y0) >= 0 and max(box.x1, box.y1) <= 1 for box in boxes)
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    assert {axis.get_ylabel() for axis in panels[:, 0]} >= {"observed", *METHODS}
    assert panels[0, 2].get_title() == "frame 5, 0.17 s" and panels[0, 0].title.get_color() != panels[0, 2].title.get_color()


def test_distances_are_zero_for_the_twin_that_moves_as_was_observed(plain):
    paints = painter(plain, FRAMES)
    exact, softer = ([distances(take, observed(plain), frame)[1].max() * DRAWN_MM for frame in FRAMES] for take in paints.takes)
    assert max(exact) < EXACT < softer[-1]
    panels = grid(strip_figure(paints, 6.0), 5, len(FRAMES))
    text = [[float(axis.texts[0].get_text().split()[0]) for axis in panels[row]] for row in (2, 4)]
    assert text[0] == [0.0] * len(FRAMES) and text[1][0] == 0.0 < text[1][-1]


def test_pictures_that_agree_have_no_difference(video):
    paints = painter(video, (0, 4, 7), style="splats", error="color")
    same, other = (paints._drawn[which][7] for which in (0, 1))
    assert (~np.isnan(same.difference)).sum() > 50 and np.nanmax(same.difference) == 0
    assert np.nanmax(other.difference) > 0.1
    # Pixels outside of the object are left out of the row; they count in the PSNR, as in the tables.
    assert same.psnr > other.psnr
    panels = grid(strip_figure(paints, 6.0), 5, 3)
    shown = [np.ma.filled(axis.images[-1].get_array(), np.nan) for axis in panels[2]]
    assert all(np.nanmax(values) == 0 for values in shown)


def test_hands_are_gray_and_not_compared(video):
    paints = painter(video, (0,), style="splats", error="color")
    whole = replace(paints.scene, box=(0, 0, paints.scene.camera.width, paints.scene.camera.height))
    again = PhotoPainter(whole, paints.takes, (0,), paints.manner, "cpu")
    drawn = again._drawn[0][0]
    assert drawn.hands[:12, :12].all() and np.isnan(drawn.difference[:12, :12]).all()
    axis = plt.figure().add_axes((0, 0, 1, 1))
    again.draw_error(axis, 0, 0)
    assert (axis.images[0].get_array()[2, 2] == 200).all()


def test_a_frame_that_a_camera_missed_and_one_behind_a_divergence_say_so(tmp_path):
    paints = painter(filmed(tmp_path, missing=(4,)), (0, 4), style="splats", error="color")
    short = replace(paints.takes[1], positions=paints.takes[1].positions[:3])
    paints = PhotoPainter(paints.scene, [paints.takes[0], short], (0, 4), paints.manner, "cpu")
    panels = grid(strip_figure(paints, 6.0), 5, 2)
    words = [[text.get_text() for text in axis.texts] for axis in panels[:, 1]]
    assert words == [["camera 0: no image"], [], ["no image"], ["diverged"], []]


def test_splats_that_a_method_moves_itself_are_where_it_puts_them(video):
    paints = painter(video, (0, 5), style="splats", error="none")
    take = paints.takes[0]
    # The nodes stand still; the splats rise by a tenth of the picture.
    still = replace(take, positions=np.repeat(take.positions[:1], 8, axis=0))
    up = 0.1 * np.ptp(take.positions[0], axis=0).max() * np.arange(8)[:, None, None] / 5 * np.array([0, 0, 1.0])
    own = replace(still, centers=(take.splats.means + up).astype(np.float32))
    rows = []
    for shown in (still, own):
        again = PhotoPainter(paints.scene, [shown], (0, 5), paints.manner, "cpu")
        rows.append([np.flatnonzero((again._drawn[0][frame].rgba[..., 3] > 128).any(axis=1)).mean() for frame in (0, 5)])
    assert rows[0][0] == rows[0][1] and rows[1][0] == rows[0][0] and rows[1][1] < rows[1][0] - 3


def test_a_far_prediction_does_not_shrink_the_picture(plain):
    paints = painter(plain, (0, 7))
    far = replace(paints.takes[1], positions=paints.takes[1].positions + np.float32(50.0))
    scene = FilmedScene.of(observed(plain), paints.scene.camera, [paints.takes[0], far], (0, 7))
    assert scene.view.width < 3 * paints.scene.view.width


def test_the_caption_names_frames_split_and_errors(plain):
    text = caption(painter(plain, FRAMES))
    assert "frames 0, 3, 5, 7; future from frame 5." in text
    assert "baseline 0.0 mm" in text and "Distance of nodes to their observed points" in text
