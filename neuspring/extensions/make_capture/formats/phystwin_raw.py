"""A case in PhysTwin's raw layout, see `neuspring.intake.phystwin_raw`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from neuspring.checks.case import RELEASED_FRAME_RATE
from neuspring.core.errors import InputError
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.feeds import Paired, Recorded
from neuspring.extensions.make_capture.formats import CaptureFormat, open_images
from neuspring.extensions.make_capture.moments import spans
from neuspring.intake.phystwin import CALIBRATION, METADATA, annotated, train_end_of
from neuspring.intake.phystwin_raw import detections, labels_of, read_calibration


def open_case(case: Path) -> Recorded:
    """A case with all its cameras. Raises InputError."""
    metadata, listed = read_calibration(case)
    cameras = {camera.name: camera for camera in listed}
    views = [
        Paired(
            name,
            open_images(case / "color" / name, "color"),
            open_images(case / "depth" / name, "depth"),
            unit=0.001,
            lens=Lens(matrix=camera.intrinsics, size=(camera.width, camera.height)),
            pose=camera.camera_to_world,
            numbered=True,
        )
        for name, camera in cameras.items()
    ]
    frames = int(metadata["frame_num"])
    for images in (images for view in views for images in view.sources):
        series = images.series
        if not series.named or series.numbers[-1] >= frames:
            rule = f"names must be frame numbers below frame_num of {METADATA}, {frames}"
            raise InputError(images.path, rule, spans(series.numbers) if series.named else images.files([0])[0].name)
    ids_of = {name: detections(case, name) for name in cameras} if (case / "mask").is_dir() else {}

    def require_masks(numbers: Mapping[str, Sequence[int]]) -> None:
        for name, one in ((name, one) for name, ids in ids_of.items() for listed in ids.values() for one in listed):
            folder = case / "mask" / name / one
            if lacking := [number for number in numbers[name] if not (folder / f"{number}.png").is_file()]:
                remedy = "Make them, take images of these frames away, or choose others with --frames."
                raise InputError(folder, "a mask of every frame with color is required", f"none of {spans(lacking)}", remedy)

    return Recorded(
        views=views,
        rate=float(metadata.get("fps", RELEASED_FRAME_RATE)),
        up="-z",
        train_end=train_end_of(case, frames),
        tracks=annotated(case, frames),
        labels=(lambda camera, number: labels_of(case, cameras[camera], number, ids_of[camera])) if ids_of else None,
        require_masks=require_masks,
    )


def _recording(paths: Sequence[Path], cameras: Sequence[str]) -> Recorded:
    if len(paths) != 1:
        raise InputError("--phystwin-raw", "one case is required, with all its cameras", len(paths))
    return open_case(paths[0])


capture_format = CaptureFormat(
    about="a case in PhysTwin's raw layout",
    recognizes=lambda path: (path / METADATA).is_file() and (path / CALIBRATION).is_file(),
    recording=_recording,
)
