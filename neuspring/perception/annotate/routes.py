"""What the page can ask for. Every camera and frame is looked up in the capture, so no address leads to another file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

from neuspring.data.capture import Capture
from neuspring.perception.annotate import pictures
from neuspring.perception.annotate.guard import Refused
from neuspring.perception.annotate.masks import Masks
from neuspring.perception.annotate.pointing import Pointing


@dataclass(frozen=True)
class Desk:
    """What all requests share."""

    capture: Capture
    masks: Masks
    pointing: Pointing

    def frame(self, camera: Any, frame: Any) -> tuple[str, int]:
        """A camera and a frame that it has. Refuses others."""
        if not isinstance(camera, str) or camera not in self.capture.cameras:
            raise Refused(404, "There is no such camera.")
        number = int(frame) if isinstance(frame, int) or (isinstance(frame, str) and re.fullmatch("[0-9]{1,7}", frame)) else -1
        if not 0 <= number < self.capture.frame_count or not self.capture.has(camera, number):
            raise Refused(404, "This camera has no such frame.")
        return camera, number


def state(desk: Desk) -> dict[str, Any]:
    """The capture, the marks and the clicks."""
    description = desk.capture.description
    cameras = [
        {"name": entry.name, "width": entry.width, "height": entry.height, "missing": list(entry.missing)}
        for entry in description.cameras
    ]
    return {
        "name": description.name,
        "folder": str(desk.capture.folder),
        "frames": description.frame_count,
        "frame_rate": description.frame_rate,
        "cameras": cameras,
        "masks": desk.masks.plain(),
        "tracks": desk.pointing.plain(),
    }


def color(desk: Desk, camera: str, frame: str) -> bytes:
    """A frame as JPEG."""
    return pictures.frame_jpeg(desk.capture.color(*desk.frame(unquote(camera), frame)))


def overlay(desk: Desk, source: str, camera: str, frame: str) -> bytes:
    """Masks of a frame as colors, PNG."""
    labels = desk.masks.labels(*desk.frame(unquote(camera), frame), source)
    if labels is None:
        raise Refused(404, "This frame has no mask.")
    return pictures.overlay_png(labels)


def preview(desk: Desk, values: dict[str, Any]) -> bytes:
    """The mask of one marked frame from its marks alone, as colors, PNG."""
    return pictures.overlay_png(desk.masks.preview(*desk.frame(values.get("camera"), values.get("frame"))))


def carry(desk: Desk, values: dict[str, Any]) -> dict[str, Any]:
    """Begin to carry the marks of the named cameras."""
    cameras = values.get("cameras")
    if not isinstance(cameras, list) or not all(isinstance(camera, str) and camera in desk.capture.cameras for camera in cameras):
        raise Refused(404, "There is no such camera.")
    desk.masks.carry(cameras)
    return desk.masks.job.plain()


def stop(desk: Desk, _: dict[str, Any]) -> dict[str, Any]:
    """Stop carrying."""
    desk.masks.job.stop()
    return desk.masks.job.plain()


GET: list[tuple[re.Pattern[str], Callable[..., Any]]] = [
    (re.compile("/api/state"), state),
    (re.compile("/api/masks"), lambda desk: desk.masks.plain()),
    (re.compile("/api/clicks"), lambda desk: desk.pointing.plain()),
    (re.compile("/api/job"), lambda desk: desk.masks.job.plain()),
    (re.compile("/api/color/([^/]+)/([0-9]+)"), color),
    (re.compile("/api/overlay/(carried|saved)/([^/]+)/([0-9]+)"), overlay),
    (re.compile("/api/tracks/([0-9]+)"), lambda desk, since: desk.pointing.results(int(since[:9]))),
]
"""Answers by path."""
POST: dict[str, Callable[[Desk, dict[str, Any]], Any]] = {
    "/api/marks": lambda desk, values: {"revision": desk.masks.write(values.get("revision"), values.get("marks"))},
    "/api/preview": preview,
    "/api/carry": carry,
    "/api/stop": stop,
    "/api/masks/save": lambda desk, _: {"cameras": desk.masks.save()},
    "/api/clicks": lambda desk, values: {"revision": desk.pointing.write(values.get("revision"), values.get("annotations"))},
    "/api/tracks/save": lambda desk, values: {"points": desk.pointing.save(replace=values.get("replace") is True)},
}
"""Answers by path."""
