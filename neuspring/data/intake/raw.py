"""PhysTwin's raw layout as a source: images, calibration, and masks, tracks and split where they are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.data import phystwin
from neuspring.data.capture import Camera
from neuspring.data.departure import refuse
from neuspring.data.intake.images import open_images
from neuspring.data.intake.views import Lens, Paired, View
from neuspring.data.json_file import load_json
from neuspring.data.phystwin_raw import CALIBRATION, annotated, cameras_of, detections, labels_of, raw_departures, train_end_of
from neuspring.data.unpickle import load_pickle


@dataclass(frozen=True, eq=False)
class Raw:
    """A case in PhysTwin's raw layout."""

    case: Path
    views: list[View]
    cameras: dict[str, Camera]
    rate: float
    train_end: int | None
    """Of all its frames."""
    tracks: np.ndarray | None
    """[T, K, 3], m, in its world."""
    ids: dict[str, dict[int, list[str]]]
    """Detections of each label, by camera; empty without masks."""

    @classmethod
    def open(cls, case: Path) -> Raw:
        """Read its calibration. Raises InputError."""
        metadata, poses = load_json(case / phystwin.METADATA), load_pickle(case / CALIBRATION)
        refuse(raw_departures(case, metadata, poses))
        cameras = {camera.name: camera for camera in cameras_of(metadata, poses)}
        views: list[View] = [
            Paired(
                name,
                open_images(case / "color" / name, "color"),
                open_images(case / "depth" / name, "depth"),
                unit=0.001,
                lens=Lens(matrix=camera.intrinsics, size=(camera.width, camera.height)),
                pose=camera.camera_to_world,
            )
            for name, camera in cameras.items()
        ]
        frames = int(metadata["frame_num"])
        return cls(
            case,
            views,
            cameras,
            float(metadata.get("fps", phystwin.RELEASED_FRAME_RATE)),
            train_end_of(case, frames),
            annotated(case, frames),
            {name: detections(case, name) for name in cameras} if (case / "mask").is_dir() else {},
        )

    def labels(self, camera: str, number: int) -> np.ndarray:
        """Mask [H, W] uint8 of a camera's frame with this number in its name. Raises InputError."""
        return labels_of(self.case, self.cameras[camera], number, self.ids[camera])
