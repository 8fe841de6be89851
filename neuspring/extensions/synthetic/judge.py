"""The stage that measures the perception of a synthetic capture against the truth."""

from __future__ import annotations

from collections.abc import Sequence

from neuspring.config import Config
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import Capture
from neuspring.stages.stage import Written, paths, stage


@stage(
    output="{scenario}/perception/judged.json",
    rule="perceive",
    reads=("perception.shape",),
    when=lambda rows: rows.source.has_truth,
)
def judge(
    capture: Capture, masks: Sequence[Before], tracks: Sequence[Before], lifted: Before, settings: Config, run: Recorder
) -> Written:
    """Perception of a synthetic capture -> its errors against the truth, as facts of the record."""
    from neuspring.data.results import LiftedTracks, masks_of_cameras, tracks_of_cameras
    from neuspring.extensions.synthetic import errors as errors_of
    from neuspring.extensions.synthetic.truth import truth_of

    masks_of, tracks_of = masks_of_cameras(capture, paths(masks)), tracks_of_cameras(capture, paths(tracks))
    truth, points = truth_of(capture), LiftedTracks.load(lifted.file("lifted"))
    errors = errors_of.judge(capture, truth, masks_of, tracks_of, points, settings.perception.shape)
    clip = {
        "certificate_mm": 1e3 * truth.certificate,
        "sensitivity_mm": 1e3 * truth.sensitivity,
        "least_jacobian": float(truth.least_jacobian.min()),
        "frames": float(capture.frame_count),
    }
    backends = {"segment": next(iter(masks_of.values())).backend, "track": next(iter(tracks_of.values())).backend}
    return Written(facts={**errors, **clip, **backends, **capture.description.provenance})
