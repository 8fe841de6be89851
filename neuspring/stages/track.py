"""Masks of one camera -> tracks of pixels."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring import config
from neuspring.config import Config
from neuspring.core.findings import told
from neuspring.core.records import Recorder, StageRecord
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception import figures
from neuspring.perception.backends import BACKENDS
from neuspring.perception.findings import look_at_tracks
from neuspring.perception.results import Masks, PixelTracks
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring track`."""
    shared.add_capture(parser)
    parser.add_argument("--camera", required=True)
    shared.add_record(parser, "masks", "masks.json")
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring track`."""
    run(a.capture.parent, a.camera, a.masks, shared.read_settings(a.settings), a.device, a.output)


def run(folder: Path, camera: str, masks_record: Path, settings: Config, device: str, output: Path) -> None:
    """Write tracks.npz, tracks.png and the record `output`."""
    section = settings.perception.track
    record = Recorder(
        "track", output, inputs={"capture": folder / CAPTURE}, settings={type(section).__name__: config.plain(section)}
    )
    capture = Capture.load(folder)
    capture.require_camera(camera)
    masks = Masks.load(StageRecord.load(masks_record).file("masks", masks_record))
    followed = BACKENDS["track"][section.backend].track(capture, camera, masks.labels, settings.perception, device)
    count = followed.pixels.shape[1]
    if not count:
        print(f"camera {camera}: neither object nor hands in frame 0; it is not used", flush=True)
    facts = {"points": float(count), "visible_share": float(followed.visible.mean()) if count else 0.0}
    tracks = PixelTracks(pixels=followed.pixels, visible=followed.visible, backend=section.backend, facts=facts)
    files = record.beside(tracks="tracks.npz", picture="tracks.png")
    tracks.save(files["tracks"])
    figures.tracks_strip(capture, camera, tracks, files["picture"])
    record.save(files, tracks.facts | told(look_at_tracks(camera, masks.labels, tracks.pixels, tracks.visible)))
