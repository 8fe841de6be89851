"""One camera of a capture -> masks of object and hands."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring import config
from neuspring.config import Config
from neuspring.core.errors import InputError
from neuspring.core.findings import told
from neuspring.core.records import Recorder
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception import figures
from neuspring.perception.backends import BACKENDS
from neuspring.perception.findings import WRONG, look_at_masks, mask_facts
from neuspring.perception.results import Masks
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring segment`."""
    shared.add_capture(parser)
    parser.add_argument("--camera", required=True)
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring segment`."""
    run(a.capture.parent, a.camera, shared.read_settings(a.settings), a.device, a.output)


def run(folder: Path, camera: str, settings: Config, device: str, output: Path) -> None:
    """Write masks.npz, masks.png and the record `output`."""
    section = settings.perception.segment
    record = Recorder(
        "segment",
        output,
        inputs={"capture": folder / CAPTURE},
        settings={type(section).__name__: config.plain(section)},
    )
    capture = Capture.load(folder)
    capture.require_camera(camera)
    labels = BACKENDS["segment"][section.backend].segment(capture, camera, settings.perception, device)
    facts = mask_facts(capture, camera, labels)
    findings = look_at_masks(capture, camera, labels, facts)
    wrong = [one for one in findings if one.name in WRONG]
    if wrong and section.verdict == "error":
        rule = "perception.segment.verdict: error asks for masks that can be right"
        raise InputError(f"{capture.folder}, camera {camera}", rule, "; ".join(one.text for one in wrong))
    masks = Masks(labels=labels, backend=section.backend, facts=facts)
    files = record.beside(masks="masks.npz", picture="masks.png")
    masks.save(files["masks"])
    figures.masks_strip(capture, camera, masks, files["picture"])
    record.save(files, masks.facts | told(findings))
