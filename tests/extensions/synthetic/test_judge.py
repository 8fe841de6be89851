"""A synthetic capture, its truth, and the stage that separates perfect from faulty perception."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from neuspring.config import ScenarioRow
from neuspring.config.perception import Lift, PointTracking, ShapePriorSettings
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.data.capture import OBJECT, Capture
from neuspring.data.results import Masks, PixelTracks
from neuspring.extensions.synthetic import make as making
from neuspring.extensions.synthetic.errors import judge, lifted_quality, mask_quality, track_quality
from neuspring.extensions.synthetic.exact import track
from neuspring.extensions.synthetic.settings import Synthetic
from neuspring.extensions.synthetic.truth import at_points, truth_of, truth_path, under_pixels
from neuspring.perception.lift import lift_tracks
from tests.support.filmed import film

ROW = ScenarioRow(scenario="box", source="synthetic", category="package", path="weird_package", self_collision=True, ground=True)
TINY = Synthetic(size="tiny", frames=6)
SETTINGS = Lift(neighborhood=0.03, controller_gaps="rigid", controller_share=0.5, least_controllers=3)


def create(folder, settings=TINY):
    return making.make(ROW, settings, folder / "capture")[0]


@pytest.fixture(scope="module")
def perfect(tmp_path_factory):
    """The capture, its truth, and what perfect masks and tracks become."""
    capture = create(tmp_path_factory.mktemp("box"))
    frames = range(capture.frame_count)
    masks = {c: Masks(labels=np.stack([capture.mask(c, f) for f in frames]), backend="given") for c in capture.cameras}
    tracks = {}
    for camera in capture.cameras:
        exact = track(capture, camera, masks[camera].labels, PointTracking())
        tracks[camera] = PixelTracks(pixels=exact.pixels, visible=exact.visible, backend="truth")
    lifted = lift_tracks(capture, masks, tracks, SETTINGS)
    return SimpleNamespace(capture=capture, truth=truth_of(capture), masks=masks, tracks=tracks, lifted=lifted)


def test_perfect_tracks_have_no_error_and_the_rest_is_the_sensor_s(perfect, monkeypatch):
    # Coarser voxels are faster.
    monkeypatch.setattr("neuspring.perception.shape.HULL_VOXEL", 0.006)
    monkeypatch.setattr("neuspring.extensions.synthetic.errors.VOLUME_GRID", 0.006)
    facts = judge(perfect.capture, perfect.truth, perfect.masks, perfect.tracks, perfect.lifted, ShapePriorSettings())
    assert facts["mask_iou_object"] == facts["mask_iou_hands"] == 1.0
    assert facts["track_p95_px"] < 1e-3
    # Depth noise of 1 mm, pixels of 5 mm.
    assert facts["lifted_median_mm"] < 3
    assert facts["controllers_median_mm"] < 3
    assert 0 < facts["hull_iou_1"] < facts["hull_iou_2"] < 1


def test_spoilt_perception_is_told_from_perfect(perfect):
    shifted = {}
    for name, own in perfect.tracks.items():
        pixels = own.pixels + np.array([3.0, 4.0], np.float32)
        pixels[0] = own.pixels[0]
        shifted[name] = replace(own, pixels=pixels)
    assert track_quality(perfect.capture, perfect.truth, shifted)["track_median_px"] == pytest.approx(5.0, abs=1e-3)
    half = {name: replace(m, labels=np.where(np.arange(m.labels.shape[2]) % 2, m.labels, 0)) for name, m in perfect.masks.items()}
    assert mask_quality(perfect.capture, half)["mask_iou_object"] == pytest.approx(0.5, abs=0.05)
    moved = perfect.lifted.object_points.copy()
    moved[1:, :, 2] += 0.02
    facts = lifted_quality(perfect.truth, replace(perfect.lifted, object_points=moved))
    assert facts["lifted_median_mm"] == pytest.approx(20, abs=2)


def test_correspondences_stay_with_the_material(perfect):
    truth = perfect.truth
    some = np.arange(0, len(truth.surface_nodes), 7)
    places = at_points(truth, truth.surface(0)[some]).places
    np.testing.assert_allclose(places[-1], truth.surface(len(truth.nodes) - 1)[some], atol=2e-5)
    camera = perfect.capture.cameras["0"]
    y, x = np.nonzero(perfect.capture.mask("0", 0) == OBJECT)
    pixels = np.stack([x, y], axis=1).astype(float)
    material = under_pixels(truth, camera, pixels)
    assert (material.face >= 0).mean() > 0.98
    own = material.face >= 0
    np.testing.assert_allclose(camera.project(material.places[0, own])[0], pixels[own], atol=1e-3)


def test_annotated_tracks_are_material_points(perfect):
    tracks = perfect.capture.tracks()
    np.testing.assert_allclose(at_points(perfect.truth, tracks[0]).places, tracks, atol=3e-5)


def test_a_clip_knows_its_numerics(perfect):
    truth = perfect.truth
    assert truth.certificate < 1e-3
    assert truth.least_jacobian.min() > 0.5
    assert truth.youngs_modulus.max() / truth.youngs_modulus.min() == pytest.approx(20)
    assert (truth.held >= 0).any()
    assert truth.touches[0].any()
    assert (np.diff(truth.kinetic[:2]) > 0).all()


def test_a_capture_follows_its_seed(perfect, tmp_path, monkeypatch):
    made = {}

    def once(name):
        real = getattr(making, name)
        monkeypatch.setattr(making, name, lambda *given: made.setdefault(name, real(*given)) if name not in made else made[name])

    # The seed changes what the sensor sees: the motion need not be settled once more, nor certified, which no image shows.
    once("settle")
    monkeypatch.setattr(making, "certify", lambda *_: (0.0, 0.0))
    again = create(tmp_path / "0")
    monkeypatch.setattr(making, "SENSOR_SEED", 1)
    other = create(tmp_path / "1")
    for kind in ("color", "depth", "mask"):
        assert again.path(kind, "1", 4).read_bytes() == perfect.capture.path(kind, "1", 4).read_bytes()
    assert other.path("color", "1", 4).read_bytes() == perfect.capture.path("color", "1", 4).read_bytes()
    assert other.path("depth", "1", 4).read_bytes() != perfect.capture.path("depth", "1", 4).read_bytes()


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("single_lift_slot", "must be a scene, or vbd/<scene>"),
        ("mpm/weird_package", "must be a scene, or vbd/<scene>"),
        ("vbd/single_lift_cloth", "the held-out engine supports only solids that hands grasp"),
        ("vbd/single_push_rope", "not cloths or pushes"),
    ],
)
def test_scenes_that_there_are_not(tmp_path, monkeypatch, path, message):
    monkeypatch.setattr(making, "settle", lambda body, rate: body.nodes)
    with pytest.raises(InputError, match=message):
        making.make(replace(ROW, path=path), TINY, tmp_path)


def test_clips_that_fail_are_refused(perfect):
    crushed = replace(perfect.truth, least_jacobian=np.full_like(perfect.truth.least_jacobian, -0.1))
    with pytest.raises(NumericalFailure, match=r"box: an element is crushed \(det F < 0\.02\) in 100% of the frames"):
        making._refuse("box", crushed)
    told = r"not converged; twice the substeps move the mean node by 5\.00 mm, a start 1 um off by 0\.10 mm"
    with pytest.raises(NumericalFailure, match=told):
        making._refuse("box", replace(perfect.truth, certificate=0.005, sensitivity=0.0001))
    making._refuse("cloth", replace(perfect.truth, certificate=0.005, sensitivity=0.004))


def test_the_backend_truth_needs_a_synthetic_capture(tmp_path):
    capture = film(tmp_path / "film", cameras=1)
    with pytest.raises(InputError, match=r"film_truth\.npz: the truth of a synthetic scene is required"):
        truth_of(capture)


def test_another_capture_s_truth_is_refused(perfect, tmp_path):
    capture = Capture.load(shutil.copytree(perfect.capture.folder, tmp_path / "capture"))
    shutil.copy(truth_path(perfect.capture.folder), truth_path(capture.folder))
    assert truth_of(capture).certificate == perfect.truth.certificate
    replace(perfect.truth, certificate=0.5).save(truth_path(capture.folder))
    with pytest.raises(InputError, match="that of another capture"):
        truth_of(capture)
