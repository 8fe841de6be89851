"""One camera on a real plush bear, where the recording is there: its hull, with and without a guess of its back."""

from pathlib import Path

import pytest

from neuspring.checks.masks import mask_facts
from neuspring.checks.perceived import look_at_masks
from neuspring.config.perception import Lift, ShapePriorSettings
from neuspring.data.capture import CAPTURE, Capture
from neuspring.data.results import Masks
from neuspring.perception.lift import clean_masks
from neuspring.perception.segment_given import segment
from neuspring.perception.shape import shape_prior
from tests.support.real import PLUSH

FIRST = 250


def assembled(folder: Path, real: Path) -> Capture:
    """The capture of frames 250 to 335, as links."""
    (folder / CAPTURE).write_bytes((real / "capture_250_335.json").read_bytes())
    for kind in ("color", "depth", "mask"):
        (folder / kind / "cam0").mkdir(parents=True)
    for frame in range(86):
        for kind in ("color", "depth"):
            (folder / kind / "cam0" / f"{frame:05d}.png").symlink_to(real / kind / f"{FIRST + frame:06d}.png")
        (folder / "mask" / "cam0" / f"{frame:05d}.png").symlink_to(real / "masks_250_335" / f"{frame:05d}.png")
    return Capture.load(folder)


@pytest.mark.skipif(not PLUSH.is_dir(), reason="the recording is not part of the repository")
def test_a_real_bear_has_a_round_back(tmp_path):
    capture = assembled(tmp_path, PLUSH)
    labels = segment(capture, "cam0")
    masks = {"cam0": Masks(labels=labels, backend="given")}
    assert look_at_masks(capture, "cam0", labels, mask_facts(capture, "cam0", labels)) == []
    _, cloud, _ = clean_masks(capture, capture.cameras, masks, Lift(), 1)
    liters, wall = {}, {}
    for how in ("none", "symmetry", "fraction"):
        prior = shape_prior(capture, masks, cloud, ShapePriorSettings(back=how))
        # The camera looks along y. A flat back has many vertices at its end.
        away = prior.vertices[:, 1]
        liters[how], wall[how] = 1e3 * prior.facts["volume"], float((away > away.max() - 0.004).mean())
        assert 0.5 < prior.facts["invented_share"] < 0.8
    # It is 19 cm high and 12 cm wide.
    assert 1.2 < liters["symmetry"] < liters["none"]
    assert 1.2 < liters["fraction"] < liters["none"] < 2.5
    assert max(wall["symmetry"], wall["fraction"]) < 0.3 * wall["none"]
