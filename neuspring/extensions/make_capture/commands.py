"""Commands `make-capture` and `cut-capture`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError
from neuspring.extensions.make_capture.options import Intake


def make_capture(intake: Intake) -> int:
    """Write a capture folder from color and depth of cameras, or from points in space, and run the checks of `check-data`; exit
    status 2 means that a check found an error."""
    from neuspring.extensions.make_capture.make import make_capture as make
    from neuspring.intake.check import check_capture, render

    if intake.list_topics:
        from neuspring.extensions.make_capture.formats.bag import Bag

        print("\n".join(Bag(path).text() for path in intake.recording))
        return 0
    capture, report = make(intake)
    print("\n".join(report))
    findings = check_capture(capture.folder)
    print(render(findings))
    print(f"written: {capture.folder}\nnext:")
    if capture.cameras and not capture.description.masks:
        print(f"  neuspring annotate {capture.folder}")
    if not capture.cameras:
        run = "snakemake --profile workflow/profiles/default --cores 2 --configfile config/data/points.yaml"
        where = capture.folder.resolve()
        print(f"  {run} --config data_root={where.parent} 'scenarios=[{where.name}]'")
    return 2 if any(one.level == "error" for one in findings) else 0


def cut_capture(
    capture: Annotated[Positional[Path], arg(help="capture folder")],
    frames: Annotated[str, arg(help="first and last frame to keep, like 12-97")],
    output: Annotated[Path, arg(help="the capture folder to write")],
) -> None:
    """Copy some frames of a capture, with masks and tracks, to a new capture; annotations of masks are not copied."""
    from neuspring.data.capture import Capture
    from neuspring.extensions.make_capture.cut import cut

    first, _, last = frames.partition("-")
    if not (first.isdigit() and last.isdigit()):
        raise InputError("--frames", "a first and a last frame are required, like 12-97", frames)
    made = cut(Capture.load(capture), int(first), int(last), output)
    print(f"written: {made.folder}, {made.frame_count} frames\nnext:\n  neuspring check-data {made.folder}")
