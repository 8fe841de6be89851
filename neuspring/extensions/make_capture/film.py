"""Checks of the files of the cameras: errors are refused, warnings and notes stand in the report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from neuspring.core.checks import Check
from neuspring.core.findings import Finding
from neuspring.extensions.make_capture.feeds import Paired
from neuspring.extensions.make_capture.formats import CameraFeed
from neuspring.extensions.make_capture.formats.video import VideoFile
from neuspring.extensions.make_capture.moments import DEPARTURE, MISSING_SHARE, Evenness, spans
from neuspring.extensions.make_capture.poses import FrameChoice


def looked_at(views: Sequence[CameraFeed], choice: FrameChoice) -> list[Finding]:
    """All findings about the feeds of all cameras and the frames that are kept."""
    return [found for check in FILM for found in check.findings("--frames", views, choice)]


def images_alone(views: Sequence[CameraFeed], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """Color without depth, or depth without color."""
    for view in views:
        if isinstance(view, Paired) and (alone := [f"{kind} {spans(numbers)}" for kind, numbers in view.alone.items() if numbers]):
            yield {"where": view.path, "camera": view.name, "text": "; ".join(alone)}


def missing_frames(views: Sequence[CameraFeed], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """Frames that some cameras have and others lack."""
    for view in views:
        if missing := [choice.numbers[frame] for frame in choice.missing(view.name)]:
            yield {"where": view.path, "camera": view.name, "text": spans(missing), "value": len(missing), "frames": missing}


def not_by_numbers(views: Sequence[CameraFeed], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """The order in which frames belong together, where numbers in names do not say it."""
    own = {f"camera {view.name}, color and depth": view.match[1] for view in views if isinstance(view, Paired)}
    for names, by in (own | choice.pairing).items():
        if by and "numbers" not in by:
            yield {"where": names, "value": by}


def uneven_time(views: Sequence[CameraFeed], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """Time stamps that follow no even clock, as of a phone in dim light: a capture has one rate."""
    for view in views:
        times, places = view.series.times, choice.places[view.name]
        if times is None:
            continue
        found = Evenness.of(times[[*places.values()]], [*places.values()])
        numbers = [choice.numbers[frame] for frame in places]
        told = {"where": view.path, "value": found.departure, "text": f"camera {view.name}: {found.text()}"}
        if found.bad:
            first, last = max(found.runs, key=lambda run: run[1] - run[0])
            slow = 1 / sorted(found.steps)[int(0.9 * len(found.steps))]
            anew = f"ffmpeg -i FILE -vf fps={slow:.0f} -crf 12 even.mp4 (depth: -c:v ffv1 even.mkv)"
            rule = f"; at most {DEPARTURE:g} frame and 1 lost picture in {1 / MISSING_SHARE:.0f} are allowed. "
            rule += f"Keep the part of one rate, --frames {numbers[first]}-{numbers[last]}"
            yield told | {"rule": rule + (f", or write videos anew: {anew}" if view.path.is_file() else "")}
        elif found.missing or found.odd:
            yield told | {"level": "warning" if found.missing else "note", "rule": ""}


def several_tracks(views: Sequence[CameraFeed], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """A file of which one video track of several is read, unnamed."""
    for images in (images for view in views if isinstance(view, Paired) for images in view.sources):
        if isinstance(images, VideoFile) and images.track is None and len(images.tracks) > 1:
            listed = "; ".join(f"{images.path}#{number} is {text}" for number, text in enumerate(images.tracks))
            yield {"where": images.path, "kind": images.kind, "text": listed, "value": len(images.tracks)}


# fmt: off
FILM = (
    Check("time jumps", "film", lambda _, choice: {"text": spans(choice.jumps)} if choice.jumps else None, None, "warning",
          "frame numbers are left out after {text}"),
    Check("images alone", "film", images_alone, None, "warning",
          "camera {camera}: images without their partner are left out: {text}"),
    Check("missing frames", "film", missing_frames, None, "warning", "camera {camera} lacks {text}; other cameras have them"),
    Check("pairs", "film", not_by_numbers, None, "note", "{where}: by {value}"),
    Check("uneven time", "film", uneven_time, None, "error", "{text}{rule}"),
    Check("several tracks", "film", several_tracks, None, "warning", "the first is read as {kind}: {text}. Name the one you mean"),
)
