"""Tracking of known motion, and the contract of CoTracker3 with a stand-in."""

import os
import pickle

import cv2
import numpy as np
import pytest
import torch

from neuspring.config.perception import PointTracking
from neuspring.core.errors import InputError
from neuspring.data.capture import Writer
from neuspring.perception import track_cotracker, track_opencv
from tests.support.captures import describe, entry

SHIFT = np.array([1.5, -0.75])
"""Pixels per frame."""
NEVER = 2.0
"""A correlation that no patch has: no point is found again."""


def texture(size=300):
    smooth = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(size, size)), (0, 0), 2.0)
    return cv2.normalize(smooth, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture
def video(tmp_path):
    """A textured square that moves before a textured wall; it is hidden by a bar in frames 3 and 4, which camera "late" lacks."""
    wall, patch = texture()[:96, :128], texture()[150:190, 150:190]
    cameras = (entry("0", 128, 96), entry("late", 128, 96, missing=(3, 4)))
    writer = Writer(tmp_path, describe(frame_count=8, cameras=cameras))
    labels0 = None
    for frame in range(8):
        image, labels = np.repeat(wall[..., None], 3, axis=2), np.zeros((96, 128), np.uint8)
        place = np.array([[1, 0, 40 + SHIFT[0] * frame], [0, 1, 30 + SHIFT[1] * frame]], float)
        moved = cv2.warpAffine(patch, place, (128, 96))
        own = cv2.warpAffine(np.full_like(patch, 255), place, (128, 96)) > 250
        image[own] = moved[own, None]
        labels[own] = 1
        if frame in (3, 4):
            image[30:60, 50:62] = 128
        for camera in cameras:
            if frame not in camera.missing:
                writer.frame(camera.name, frame, image, np.full((96, 128), 800, np.uint16), labels)
        labels0 = labels if labels0 is None else labels0
    return writer.finish(), np.repeat(labels0[None], 8, axis=0)


def error(tracks, frame):
    return np.linalg.norm(tracks.pixels[frame] - tracks.pixels[0] - SHIFT * frame, axis=1)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(track_opencv, "MOST_TRACKED", 300)


def test_points_move_with_the_texture(video):
    capture, labels = video
    tracks = track_opencv.track(capture, "0", labels, PointTracking())
    seen = tracks.visible[2]
    assert seen.mean() > 0.8
    assert np.median(error(tracks, 2)[seen]) < 0.25


def test_hidden_points_are_lost_and_found_again(video, monkeypatch):
    capture, labels = video
    tracks = track_opencv.track(capture, "0", labels, PointTracking())
    monkeypatch.setattr(track_opencv, "LIKENESS", NEVER)
    without = track_opencv.track(capture, "0", labels, PointTracking())
    behind = (np.abs(tracks.pixels[0, :, 0] + 3 * SHIFT[0] - 56) < 4) & (np.abs(tracks.pixels[0, :, 1] + 3 * SHIFT[1] - 45) < 10)
    assert behind.sum() > 10
    assert tracks.visible[3][behind].mean() < 0.3
    again = tracks.visible[7] & behind
    assert again.sum() > 0.6 * behind.sum() > without.visible[7][behind].sum()
    assert np.median(error(tracks, 7)[again]) < 0.5


def test_missing_frames_are_bridged(video, monkeypatch):
    capture, labels = video
    monkeypatch.setattr(track_opencv, "FLOW_SIDE", 15)
    tracks = track_opencv.track(capture, "late", labels, PointTracking())
    assert not tracks.visible[[3, 4]].any()
    seen = tracks.visible[5]
    assert seen.mean() > 0.5
    assert np.median(error(tracks, 5)[seen]) < 0.5


def test_points_start_in_the_mask_and_are_the_same_every_time(video):
    _, labels = video
    first, second = track_opencv.choose(labels[0], 50), track_opencv.choose(labels[0], 50)
    np.testing.assert_array_equal(first, second)
    x, y = first.astype(int).T
    assert labels[0, y, x].all()
    assert len(track_opencv.choose(labels[0], 10**6)) == (labels[0] > 0).sum()


def test_an_empty_mask_has_no_points(video):
    capture, labels = video
    assert track_opencv.track(capture, "0", np.zeros_like(labels), PointTracking()).pixels.shape == (8, 0, 2)


def test_points_leave_a_mask_that_stays_behind_unless_its_rim_is_wide(video, monkeypatch):
    capture, labels = video
    monkeypatch.setattr(track_opencv, "LIKENESS", NEVER)
    tight, wide = (track_opencv.track(capture, "0", labels, PointTracking(rim=rim)) for rim in (0.0, 20.0))
    places = np.round(wide.pixels[2]).astype(int)
    outside = wide.visible[2] & (labels[2, places[:, 1], places[:, 0]] == 0)
    assert outside.sum() > 10
    assert not tight.visible[2][outside].any()


def test_a_point_beside_the_mask_belongs_to_the_nearest_label(video):
    capture, labels = video
    narrow = np.stack([cv2.erode(own, np.ones((13, 13), np.uint8)) for own in labels])
    y, x = np.nonzero(labels[0])
    point = np.array([[x.max() - 5, (y.min() + y.max()) / 2]], np.float32)
    start = np.concatenate([point, track_opencv.choose(narrow[0], 200)])
    wide, tight = (track_opencv.follow(capture, "0", narrow, start, PointTracking(rim=rim)) for rim in (4.0, 0.0))
    assert wide.visible[1, 0]
    assert error(wide, 1)[0] < 0.25
    assert not tight.visible[1:, 0].any()


class StandIn:
    """Implements the interface of CoTracker3's online predictor: points move by SHIFT; it insists on windows of 2 step frames."""

    step = 3

    def __init__(self):
        self.frames, self.queries = 0, None
        self.windows: list[tuple[int, ...]] = []

    def to(self, device):
        return self

    def __call__(self, video_chunk, is_first_step=False, queries=None):
        assert video_chunk.dtype == torch.float32
        assert video_chunk.shape[1] == 2 * self.step
        if is_first_step:
            self.queries = queries
            return None, None
        self.windows.append(tuple(video_chunk.shape))
        self.frames = self.frames + self.step if self.frames else 2 * self.step
        time = torch.arange(self.frames)[:, None, None]
        tracks = self.queries[0, :, 1:] + time * torch.tensor(SHIFT, dtype=torch.float32)
        return tracks[None], torch.ones(1, self.frames, tracks.shape[1], dtype=torch.bool)


def test_cotracker_is_called_as_its_online_predictor_wants(video):
    capture, labels = video
    model = StandIn()
    tracks = track_cotracker.track(capture, "0", labels, PointTracking(), "cpu", model)
    assert tuple(model.queries.shape) == (1, 300, 3)
    assert not model.queries[0, :, 0].any()
    assert model.windows == [(1, 6, 3, 96, 128)] * 2
    assert tracks.visible.all()
    assert error(tracks, 7).max() < 1e-4
    tracks = track_cotracker.track(capture, "late", labels, PointTracking(), "cpu", StandIn())
    assert not tracks.visible[[3, 4]].any()


def test_cotracker_without_weights_says_where_they_would_be(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    told = r"code and checkpoints/scaled_online\.pth must be in the torch\.hub cache.*download: true"
    with pytest.raises(InputError, match=told):
        track_cotracker.load(PointTracking())


HUB = """
import torch

class Predictor:
    def __init__(self):
        self.model = torch.nn.Linear(2, 1)

def cotracker3_online(*, pretrained=True):
    assert not pretrained, "the hub's own reader of weights must not be used"
    return Predictor()
"""


def test_cotracker_s_weights_are_read_as_tensors_alone(monkeypatch, tmp_path):
    """A stand-in hub folder: plain weights are loaded, a pickle that would run something is refused."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    code = tmp_path / "hub" / "facebookresearch_co-tracker_main"
    weights = tmp_path / "hub" / "checkpoints" / track_cotracker.WEIGHTS
    code.mkdir(parents=True)
    weights.parent.mkdir()
    (code / "hubconf.py").write_text(HUB)
    torch.save({"weight": torch.tensor([[3.0, 4.0]]), "bias": torch.zeros(1)}, weights)
    assert track_cotracker.load(PointTracking()).model.weight.tolist() == [[3.0, 4.0]]
    torch.save({"weight": Harmful(tmp_path / "ran")}, weights)
    with pytest.raises(pickle.UnpicklingError, match=r"[Ww]eights"):
        track_cotracker.load(PointTracking())
    assert not (tmp_path / "ran").exists()


class Harmful:
    """Unpickled, it would make a folder."""

    def __init__(self, place):
        self.place = place

    def __reduce__(self):
        return os.mkdir, (str(self.place),)
