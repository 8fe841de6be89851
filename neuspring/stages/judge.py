"""Perception of a synthetic capture -> its errors against the truth."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from neuspring import config
from neuspring.config import Config
from neuspring.core.records import Recorder, StageRecord
from neuspring.data.capture import CAPTURE, Capture
from neuspring.data.synthetic.truth import truth_of
from neuspring.perception.judge import judge
from neuspring.perception.results import LiftedTracks, masks_of_cameras, tracks_of_cameras
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring judge`."""
    shared.add_capture(parser)
    shared.add_masks(parser)
    shared.add_tracks(parser)
    shared.add_record(parser, "lifted", "lifted.json")
    shared.add_settings(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring judge`."""
    run(a.capture.parent, a.masks, a.tracks, a.lifted, shared.read_settings(a.settings), a.output)


def run(
    folder: Path,
    masks_records: Sequence[Path],
    tracks_records: Sequence[Path],
    lifted_record: Path,
    settings: Config,
    output: Path,
) -> None:
    """Write the record `output`, whose facts are the errors."""
    section = settings.perception.shape
    record = Recorder(
        "judge", output, inputs={"capture": folder / CAPTURE}, settings={type(section).__name__: config.plain(section)}
    )
    capture = Capture.load(folder)
    masks, tracks = masks_of_cameras(capture, masks_records), tracks_of_cameras(capture, tracks_records)
    lifted = LiftedTracks.load(StageRecord.load(lifted_record).file("lifted", lifted_record))
    truth = truth_of(capture)
    errors = judge(capture, truth, masks, tracks, lifted, section)
    clip = {
        "certificate_mm": 1e3 * truth.certificate,
        "sensitivity_mm": 1e3 * truth.sensitivity,
        "least_jacobian": float(truth.least_jacobian.min()),
        "frames": float(capture.frame_count),
    }
    backends = {"segment": next(iter(masks.values())).backend, "track": next(iter(tracks.values())).backend}
    record.save(facts={**errors, **clip, **backends, **capture.description.provenance})
