"""Masks and tracks of all cameras -> points in the world, and a shape prior."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from neuspring import config
from neuspring.config import Config
from neuspring.core.findings import told
from neuspring.core.records import Recorder
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception import figures
from neuspring.perception.color import from_color
from neuspring.perception.findings import look_at_lifted
from neuspring.perception.lift import lift
from neuspring.perception.results import masks_of_cameras, tracks_of_cameras
from neuspring.perception.shape import shape_prior
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring lift`."""
    shared.add_capture(parser)
    shared.add_masks(parser)
    shared.add_tracks(parser)
    shared.add_settings(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring lift`."""
    run(a.capture.parent, a.masks, a.tracks, shared.read_settings(a.settings), a.output)


def run(folder: Path, masks_records: Sequence[Path], tracks_records: Sequence[Path], settings: Config, output: Path) -> None:
    """Write lifted.npz, shape.npz, lifted.png and the record `output`, from the records of all cameras in the capture's order.

    Of color alone also image.npz: what losses read of the image.
    """
    perception = settings.perception
    sections = (perception.lift, perception.shape, perception.color)
    record = Recorder(
        "lift",
        output,
        inputs={"capture": folder / CAPTURE},
        settings={type(section).__name__: config.plain(section) for section in sections},
    )
    capture = Capture.load(folder)
    masks, tracks = masks_of_cameras(capture, masks_records), tracks_of_cameras(capture, tracks_records)
    image = None
    if capture.has_depth:
        lifted = lift(capture, masks, tracks, perception.lift)
        prior = shape_prior(capture, masks, lifted.cloud, perception.shape)
    else:
        lifted, prior, image = from_color(capture, masks, tracks, perception)
    files = record.beside(lifted="lifted.npz", shape="shape.npz", picture="lifted.png")
    if image is not None:
        files |= record.beside(image="image.npz", hands="hands.png")
        image.save(files["image"])
        figures.hands_strip(capture, image, files["hands"])
    lifted.save(files["lifted"])
    prior.save(files["shape"])
    figures.lifted_figure(lifted, prior, files["picture"])
    up = 1.0 if capture.description.up == "+z" else -1.0
    facts = lifted.facts | {"shape": prior.backend} | {f"shape_{name}": value for name, value in prior.facts.items()}
    record.save(files, facts | told(look_at_lifted(lifted, prior, up, image)))
