"""Commands `make-capture` and `cut-capture`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.options import Intake


def make_capture(intake: Intake) -> None:
    """Color and depth of a camera, or points in space -> a capture folder. What was found is printed, and the next command."""
    from neuspring.extensions.make_capture.make import make_capture as make

    if intake.list_topics:
        from neuspring.extensions.make_capture.formats.bag import Bag

        if not intake.bag:
            raise InputError("--list", "is for --bag", "none", "Give --bag FILE.")
        print("\n".join(Bag(path).text() for path in intake.bag))
        return
    capture, report = make(intake)
    print("\n".join(report))
    print(f"written: {capture.folder}\nnext:")
    print(f"  neuspring check-data {capture.folder}")
    if capture.cameras and not capture.description.masks:
        print(f"  neuspring annotate {capture.folder}")
    if not capture.cameras:
        run = "snakemake --profile workflow/profiles/default --cores 2 --configfile config/data/points.yaml"
        where = capture.folder.resolve()
        print(f"  {run} --config data_root={where.parent} 'scenarios=[{where.name}]'")


def cut_capture(
    capture: Annotated[Positional[Path], arg(help="capture folder")],
    frames: Annotated[str, arg(help="first and last frame that are kept, like 12-97")],
    output: Annotated[Path, arg(help="the capture folder to write")],
) -> None:
    """Some frames of a capture, with their masks and tracks -> another capture; marks stay behind."""
    from neuspring.data.capture import Capture
    from neuspring.extensions.make_capture.cut import cut

    first, _, last = frames.partition("-")
    if not (first.isdigit() and last.isdigit()):
        raise InputError("--frames", "a first and a last frame are required, as in 12-97", frames)
    made = cut(Capture.load(capture), int(first), int(last), output)
    print(f"written: {made.folder}, {made.frame_count} frames\nnext:\n  neuspring check-data {made.folder}")
