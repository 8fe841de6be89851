"""Commands on masks: mask, compare-masks."""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.cli import options as shared

if TYPE_CHECKING:
    from collections.abc import Callable

    from neuspring.config.perception import Segmentation
    from neuspring.data.capture import Capture
    from neuspring.perception.marks.carry import Carried
    from neuspring.perception.marks.marks import Mark

SHOWN = 5
"""How many doubtful frames are named per camera."""


def mask_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring mask`."""
    parser.add_argument("capture", type=Path, help="capture folder")
    parser.add_argument("--marks", type=Path, help="marks of object and hands; marks.json of the capture by default")
    parser.add_argument("--backend", choices=["marks", "sam2"], default="marks", help="sam2 needs its weights")
    parser.add_argument("--cameras", nargs="+", help="all that have marks by default")
    parser.add_argument("--again", action="store_true", help="also where marks, images and settings are unchanged")
    shared.add_settings(parser)
    shared.add_device(parser)


def mask(a: Namespace) -> int:
    """`neuspring mask`: 0 done, 2 bad input."""
    from neuspring.core.errors import InputError
    from neuspring.data.capture import Capture
    from neuspring.perception.marks import store
    from neuspring.perception.marks.marks import MARKS, Marks

    capture = Capture.load(a.capture)
    path = a.marks or a.capture / MARKS
    marks = Marks.load(path)
    marks.require(capture, path)
    segmentation = shared.read_settings(a.settings).perception.segment
    settings = segmentation.marks if a.backend == "marks" else segmentation.grounded_sam2
    wanted = a.cameras or [name for name in capture.cameras if marks.of(name)]
    for name in wanted:
        capture.require_camera(name)
        if not marks.of(name):
            raise InputError(f"{path}, cameras", f"camera {name} needs marks", sorted(marks.cameras))
    if not wanted:
        raise InputError(f"{path}, cameras", "a camera of the capture needs marks", sorted(marks.cameras))
    made = store.Made.of(capture)
    for name in wanted:
        source = store.source_digest(capture, name, marks.of(name), a.backend, settings)
        if made.holds(capture, name, source) and not a.again:
            picture, doubts = store.sheet_of(capture, name), made.cameras[name].doubt
            print(f"camera {name}: marks, images and settings are unchanged; its masks are kept; look at {picture}")
        else:
            carried = _carry(capture, name, marks.of(name), a.backend, segmentation, a.device)
            doubts = store.save_carried(capture, name, carried, source, a.backend).doubt
            picture = store.sheet_of(capture, name)
            print(f"camera {name}: masks are in {a.capture / 'mask' / name}; look at {picture}")
        worst = sorted(range(len(doubts)), key=lambda frame: -doubts[frame])[:SHOWN]
        print(f"camera {name}: most doubtful frames: " + ", ".join(f"{frame} ({doubts[frame]:.2f})" for frame in worst))
    without = [name for name in capture.cameras if not store.has_masks(capture, [name])]
    if without:
        print(f"cameras without masks: {', '.join(without)}; {capture.folder / 'capture.json'} says masks: true when all have some")
    return 0


def _carry(capture: Capture, name: str, marks: tuple[Mark, ...], backend: str, settings: Segmentation, device: str) -> Carried:
    from neuspring.perception import segment_sam2
    from neuspring.perception.marks import store

    if backend == "sam2":
        from neuspring.core.device import resolve_device

        return segment_sam2.carry(capture, name, marks, settings.grounded_sam2, resolve_device(device))
    return store.carry_camera(capture, name, marks, settings.marks, progress=_bar(f"camera {name}"))


def _bar(name: str) -> Callable[[int, int], None]:
    """A line that shows how far the work is: on a terminal it is drawn over and over, elsewhere it is written ten times."""
    began, live, told = time.perf_counter(), sys.stderr.isatty(), [-1]

    def show(done: int, total: int) -> None:
        tenth = 10 * done // max(total, 1)
        if live or tenth != told[0]:
            told[0] = tenth
            left = (time.perf_counter() - began) / max(done, 1) * (total - done)
            line = f"{name}: {'#' * (2 * tenth):<20} {100 * done // max(total, 1):3d} %, {left:.0f} s left"
            print(f"\r{line:<70}" if live else line, end="" if live and done < total else "\n", file=sys.stderr, flush=True)

    return show


def compare_masks_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring compare-masks`."""
    parser.add_argument("masks", type=Path, help="folder of masks, <frame>.png")
    parser.add_argument("truth", type=Path, help="folder of masks to compare with; its frames count")


def compare_masks(a: Namespace) -> int:
    """`neuspring compare-masks`: a table of IoU per frame."""
    from neuspring.perception.marks.store import compare, table

    print(table(compare(a.masks, a.truth)), end="")
    return 0
