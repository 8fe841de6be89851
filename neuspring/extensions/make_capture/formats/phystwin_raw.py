"""Cases in PhysTwin's raw layout, converted by `neuspring.intake.phystwin_raw`."""

from __future__ import annotations

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.make_capture.formats import CaptureFormat
from neuspring.extensions.make_capture.options import Intake
from neuspring.intake.phystwin import CALIBRATION, METADATA
from neuspring.intake.phystwin_raw import convert


def _capture(intake: Intake) -> Capture:
    given = [f"--{name}" for name in ("rig", "frames", "shift", "topics", "train_end") if getattr(intake, name)]
    if given or len(intake.recording) != 1:
        remedy = "Remove these options, since the case contains their values; use `neuspring cut-capture` to keep some frames."
        raise InputError(
            "--recording", "exactly one case, without other options, is required", " ".join(given) or "several cases", remedy
        )
    return convert(intake.called, intake.category, intake.recording[0], intake.output)


capture_format = CaptureFormat(
    about="a case in PhysTwin's raw layout",
    recognizes=lambda path: (path / METADATA).is_file() and (path / CALIBRATION).is_file(),
    capture=_capture,
)
