"""Commands on data: check-data, mask, compare-masks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import Device, Positional, Settings, arg, read_settings
from neuspring.core.errors import InputError

DOUBTFUL_FRAMES_SHOWN = 5
"""Number of doubtful frames that are printed per camera."""


def check_data(folder: Positional[Path], settings: Settings = "{}") -> int:
    """Report differences between a data folder and the expected layout; exit status 2 if the folder cannot be used."""
    from neuspring.intake.check import check_layout, render

    findings = check_layout(folder, read_settings(settings))
    print(render(findings))
    return 2 if any(finding.level == "error" for finding in findings) else 0


def mask(
    capture: Annotated[Positional[Path], arg(help="capture folder")],
    marks: Annotated[Path | None, arg(help="annotations of object and hands; default: marks.json of the capture")] = None,
    backend: Annotated[Literal["marks", "sam2"], arg(help="sam2 requires its weights")] = "marks",
    cameras: Annotated[tuple[str, ...], arg(help="default: all cameras with annotations")] = (),
    again: Annotated[bool, arg(help="remake masks even if annotations, images and settings are unchanged")] = False,
    masks: Annotated[
        tuple[Path, ...], arg(help="import masks of another tool: one folder per camera; 0 background, 1 object, 2 hands")
    ] = (),
    hands: Annotated[
        tuple[Path, ...], arg(help="hand masks for --masks: one folder per camera; then every nonzero pixel counts in both")
    ] = (),
    settings: Settings = "{}",
    device: Device = "auto",
) -> None:
    """Make masks of object and hands in every frame of a capture, from annotations or from masks of another tool."""
    from neuspring.checks.masks import mask_facts
    from neuspring.checks.perceived import look_at_masks
    from neuspring.core.text import Progress
    from neuspring.data.capture import Capture
    from neuspring.perception import masks as store
    from neuspring.perception.backends import SEGMENTERS
    from neuspring.perception.marks import MARKS, Marks

    read, path = Capture.load(capture), marks or capture / MARKS
    if masks or hands:
        named = cameras or tuple(read.cameras)
        if len(masks) != len(named) or len(hands) not in (0, len(named)):
            rule = f"one folder is required per camera ({' '.join(named)}); --cameras selects cameras"
            raise InputError("--masks, --hands", rule, f"{len(masks)} and {len(hands)}")
        for name, folder, hand_folder in zip(named, masks, hands or [None] * len(named), strict=True):
            read.require_camera(name)
            print(f"camera {name}: masks are in {store.import_masks(read, name, folder, hand_folder)}")
        print(f"next:\n  neuspring check-data {capture}")
        return
    marked = Marks.load(path)
    marked.require(read, path)
    perception, carrier = read_settings(settings).perception, SEGMENTERS["marks" if backend == "marks" else "grounded_sam2"]
    wanted = cameras or tuple(name for name in read.cameras if marked.of(name))
    for name in wanted or read.cameras:
        read.require_camera(name)
        if not marked.of(name):
            raise InputError(f"{path}, cameras", f"camera {name} requires annotations", sorted(marked.cameras))
    made = store.MasksFile.of(read)
    for name in wanted:
        source = store.source_digest(read, name, marked.of(name), backend)
        if made.holds(read, name, source) and not again:
            doubts = made.cameras[name].doubt
            outcome = "annotations, images and settings are unchanged; its masks are kept"
        else:
            carried = carrier.carry(read, name, marked.of(name), perception, device, Progress(f"camera {name}", 0).of)
            doubts = store.save_carried(read, name, carried, source, backend).doubt
            for finding in look_at_masks(read, name, carried.labels, mask_facts(read, name, carried.labels)):
                print(finding)
            outcome = f"masks are in {capture / 'mask' / name}"
        print(f"camera {name}: {outcome}. Check {store.sheet_of(read, name)}")
        worst = sorted(range(len(doubts)), key=lambda frame: -doubts[frame])[:DOUBTFUL_FRAMES_SHOWN]
        print(f"camera {name}: most doubtful frames: " + ", ".join(f"{frame} ({doubts[frame]:.2f})" for frame in worst))
    if without := [name for name in read.cameras if not store.has_masks(read, [name])]:
        print(f"cameras without masks: {', '.join(without)}. capture.json gets masks: true when all cameras have masks.")


def compare_masks(
    masks: Annotated[Positional[Path], arg(help="folder of masks <frame>.png")],
    truth: Annotated[Positional[Path], arg(help="folder of true masks; its frames are compared")],
) -> None:
    """Print the overlap of two folders of masks per frame."""
    from neuspring.perception.masks import compare, table

    print(table(compare(masks, truth)), end="")
