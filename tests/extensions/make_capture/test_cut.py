"""Some frames of a capture, with all that belongs to them."""

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import REST, Capture
from neuspring.extensions.make_capture.cut import cut
from neuspring.intake.points import read
from tests.support import spaced as scene
from tests.support.captures import describe, entry, write
from tests.support.spaced import spaced


def test_frames_are_cut_out_with_their_masks_tracks_and_gaps(tmp_path):
    tracks = np.random.default_rng(1).normal(size=(12, 3, 3)).round(6)
    whole = write(tmp_path / "whole", describe(frame_count=12, cameras=(entry("a"), entry("b", missing=(0, 5, 11)))), tracks)
    part = cut(whole, 3, 9, tmp_path / "part")
    assert (part.description.name, part.frame_count, part.train_end) == ("part", 7, 4)
    assert [camera.missing for camera in part.description.cameras] == [(), (2,)]
    for frame in (0, 6):
        for kind in ("color", "depth", "mask"):
            np.testing.assert_array_equal(getattr(part, kind)("b", frame), getattr(whole, kind)("b", frame + 3))
    np.testing.assert_array_equal(Capture.load(part.folder).tracks(), tracks[3:10])
    assert not part.path("color", "a", 7).exists()


@pytest.mark.parametrize(
    ("first", "last", "message"),
    [(3, 12, "at least five frames of 0 to 11.*received 3-12"), (3, 6, "received 3-6"), (5, 9, "camera b must have the first")],
)
def test_frames_that_make_no_capture_are_not_cut(tmp_path, first, last, message):
    whole = write(tmp_path / "whole", describe(frame_count=12, cameras=(entry("a"), entry("b", missing=(5,)))))
    with pytest.raises(InputError, match=message):
        cut(whole, first, last, tmp_path / "part")
    with pytest.raises(InputError, match="must be a new or empty folder"):
        cut(whole, 0, 9, whole.folder)


def test_a_capture_is_cut_with_its_hands_and_nodes(tmp_path):
    original = spaced(tmp_path / "lifted")
    np.savez(original.folder / REST, points=np.ones((56, 3)))
    part = cut(original, 0, 5, tmp_path / "part")
    np.testing.assert_allclose(read(part).hands.points, scene.risen(scene.GRIP, 6))
    assert len(read(part).nodes) == len(scene.NODES)
    assert len(read(part).rest) == 56
    with pytest.raises(InputError, match=r"nodes\.npz.*frame 0.*the cut must start there; received frame 1"):
        cut(original, 1, 6, tmp_path / "later")
