"""Checks of the files of the cameras: errors are refused, warnings and notes stand in the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.timing import Shift, Streams, Watched, measure, of_cameras
from neuspring.core.checks import Check
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding
from neuspring.core.text import Progress
from neuspring.extensions.make_capture.feeds import Paired
from neuspring.extensions.make_capture.formats.video import VideoFile
from neuspring.extensions.make_capture.moments import DEPARTURE, MISSING_SHARE, Evenness, Match, spans
from neuspring.extensions.make_capture.poses import FrameChoice, meters_of, plain
from neuspring.extensions.make_capture.table import Unit


def looked_at(views: Sequence[Paired], choice: FrameChoice) -> list[Finding]:
    """All findings about the feeds of all cameras and the frames that are kept."""
    return [found for check in FILM for found in check.findings("--frames", views, choice)]


MOST_WATCHED = 240
"""Frames of a camera in which motion is looked for."""


def watch(views: Sequence[Paired], choice: FrameChoice, unit: Unit | None) -> dict[str, Watched]:
    """Motion in the first MOST_WATCHED frames of every camera. Raises InputError for images that cannot be read."""
    frames, watched = min(len(choice.numbers), MOST_WATCHED), dict[str, Watched]()
    progress, done = Progress("make-capture: motion", sum(min(len(of), frames) for of in choice.places.values())), 0
    for view in views:
        watched[view.name] = Watched(frames)
        places = {frame: place for frame, place in sorted(choice.places[view.name].items()) if frame < frames}
        for frame, (color, depth) in zip(places, view.read([*places.values()]), strict=True):
            meters = None if depth is None or unit is None else meters_of(plain(depth), unit)
            watched[view.name].see(frame, color, meters)
            done += 1
            progress.update(done)
    return watched


def in_step(views: Sequence[Paired], watched: Mapping[str, Watched], late: Mapping[str, int]) -> list[Finding]:
    """Color against depth of every camera, by what moves. `late` are streams that --shift names.

    Raises InputError where names can be read in two ways and nothing moves that says which is right.
    """
    pairs = []
    for view in views:
        if view.depth is not None:
            shift, names = measure(watched[view.name].color, watched[view.name].depth), (f"color {view.name}", f"depth {view.name}")
            pairs.append(_streams(view.path, names, f"{view.name}.depth", shift, view.match, late))
    return examine("streams", "--shift", pairs)


def cameras_in_step(
    views: Sequence[Paired], choice: FrameChoice, maps: Mapping[str, np.ndarray], late: Mapping[str, int]
) -> list[Finding]:
    """Cameras against the first, by what moves in space. Raises InputError as `in_step`."""
    shifts, pairs = of_cameras(maps) if maps else {}, []
    for view in views[1:]:
        names, match = (f"camera {views[0].name}", f"camera {view.name}"), choice.pairing[view.name]
        pairs.append(_streams(view.path, names, view.name, shifts.get(view.name), match, late))
    return examine("streams", "--shift", pairs)


def _streams(where: Path, names: Sequence[str], stream: str, shift: Shift | None, match: Match, late: Mapping[str, int]) -> Streams:
    if match.rival and stream not in late and not (shift and shift.known):
        rule = f"{names[0]} and {names[1]} have as many pictures with the same gaps, and too little moves to tell which are of "
        remedy = f"Give --shift {stream}=0 for the order, or --shift {stream}={match.rival} for equal numbers."
        raise InputError(where, f"{rule}one moment", match.by, remedy)
    return Streams(names[0], names[1], shift, f"Give --shift {stream}={{frames}}.", moved=late.get(stream, 0))


def images_alone(views: Sequence[Paired], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """Color without depth, or depth without color."""
    for view in views:
        if alone := [f"{kind} {spans(numbers)}" for kind, numbers in view.alone.items() if numbers]:
            yield {"where": view.path, "camera": view.name, "text": "; ".join(alone)}


def missing_frames(views: Sequence[Paired], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """Frames that some cameras have and others lack."""
    for view in views:
        if missing := [choice.numbers[frame] for frame in choice.missing(view.name)]:
            yield {"where": view.path, "camera": view.name, "text": spans(missing), "value": len(missing), "frames": missing}


def not_by_numbers(views: Sequence[Paired], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """The order in which frames belong together, where numbers in names do not say it."""
    own = {f"camera {view.name}, color and depth": view.match for view in views}
    for names, match in (own | {f"cameras {views[0].name} and {name}": match for name, match in choice.pairing.items()}).items():
        if match.by and not match.by.endswith("numbers in their names"):
            yield {"where": names, "value": match.by}


def uneven_time(views: Sequence[Paired], choice: FrameChoice) -> Iterator[dict[str, Any]]:
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


def several_tracks(views: Sequence[Paired], choice: FrameChoice) -> Iterator[dict[str, Any]]:
    """A file of which one video track of several is read, unnamed."""
    for images in (images for view in views for images in view.sources):
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
