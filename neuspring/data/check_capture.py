"""Departures of a capture folder from its format, image by image, and from what a scene on a table looks like.

What cannot work is an error, what is only unusual a warning with the next move; see `plausible`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, OBJECT, POINTS, TRACKS, Capture, Description, description_departures, read_description
from neuspring.data.departure import Departure, Inspection, broken, note
from neuspring.data.intake.plane import cloud, planes
from neuspring.data.intake.units import FAR, FASTEST, NEAR, SLOWEST
from neuspring.data.plausible.alone import alone_departures, horizon_departures, object_on_table, size_findings
from neuspring.data.plausible.masks import Shown, mask_findings
from neuspring.data.plausible.table import table_departures
from neuspring.data.plausible.things import (
    Sample,
    depth_findings,
    hand_findings,
    lifted,
    place_findings,
    reach_findings,
    sampled,
)
from neuspring.data.plausible.views import view_departures

INSIDE, INSIDE_SHARE = 0.01, 0.05
"""m, and share of the object's points: deeper in an obstacle than depth cameras err, they are inside."""
LEAST_AROUND = 0.1
"""Share of the image that must have depth, beside object and hands, before the table is looked for."""


def is_capture(folder: Path) -> bool:
    """Whether the folder holds a capture."""
    return (folder / CAPTURE).exists()


def check_capture(folder: Path) -> list[Departure]:
    """Description, calibration, every image, masks of frame 0, tracks, marked points."""
    case, path = Inspection(folder), folder / CAPTURE
    description = case.load(path, read_description)
    if description is None:
        return case.departures
    case.departures += description_departures(path, description)
    case.departures += rate_departures(path, description.frame_rate)
    capture = Capture(folder, description)
    calibrated = not any(d.level == "error" for d in case.departures)
    samples = {name: _check_camera(case, capture, name, calibrated) for name in capture.cameras}
    if calibrated and len(samples) > 1:
        first = {name: found[0].depth for name, found in samples.items() if 0 in found}
        case.departures += view_departures(path, capture.cameras, first, description.up)
    case.load(folder / TRACKS, lambda _: capture.tracks())
    for name in capture.cameras:
        case.load(folder / POINTS, lambda _, name=name: capture.points(name))  # type: ignore[misc]
    if not description.masks:
        message = f"no masks yet (masks: false). Draw them: `neuspring annotate {folder}`; then check again"
        case.departures.append(note(path, message))
    return case.departures


def rate_departures(path: Path, rate: float) -> list[Departure]:
    """A departure of a frame rate that no depth camera has. Speeds and forces of the twin scale with it."""
    if SLOWEST <= rate <= FASTEST:
        return []
    rule = f"frames per second at which it was filmed are required, {SLOWEST:g} to {FASTEST:g}"
    return [broken(path, "frame_rate", rule, f"{rate:g}")]


def _check_camera(case: Inspection, capture: Capture, name: str, calibrated: bool) -> dict[int, Sample]:
    """Check every image of a camera, and a few frames against the world; returns these."""
    view = capture.cameras[name]
    depths, shown = [], Shown(capture.frame_count, (view.width, view.height))
    samples: dict[int, Sample] = {}
    wanted = sampled(capture.frame_count)
    for frame in range(capture.frame_count):
        if not capture.has(name, frame):
            continue
        try:
            capture.color(name, frame)
            depth = capture.depth(name, frame)
            if capture.has_depth:
                depths.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan)
            mask = np.zeros(depth.shape, np.uint8)
            if capture.description.masks:
                mask = capture.mask(name, frame)
                shown.see(frame, mask)
            if frame in wanted:
                samples[frame] = Sample(depth, mask)
        except InputError as error:
            case.departures.append(Departure.of_error(error))
    wrong = depth_departures(capture, name, depths)
    case.departures += wrong
    if calibrated and not capture.has_depth:
        case.departures += _alone_departures(capture, name, samples)
    elif calibrated and not wrong:
        case.departures += _world_departures(capture, name, samples)
    masks = capture.folder / "mask" / name
    case.departures += [Departure.of_finding(masks, one) for one in mask_findings(name, shown)]
    return samples


def _world_departures(capture: Capture, name: str, samples: dict[int, Sample]) -> list[Departure]:
    """The table, and object and hands in the masks, of one camera."""
    path, camera, up = capture.folder / CAPTURE, capture.cameras[name], capture.description.up
    is_counted = capture.description.depth_format == "png"
    unit = capture.description.depth_unit if is_counted else None
    # Object and hands are no table; what is left must be enough of the image to tell one.
    around = [np.where(sample.mask == 0, sample.depth, 0.0) for sample in samples.values()]
    enough = around and np.mean([(depth > 0).mean() for depth in around]) >= LEAST_AROUND
    found = planes(cloud(around, camera.intrinsics)) if enough else []
    departures = table_departures(path, name, found, camera.camera_to_world, up, unit)
    bodies = {frame: lifted(camera, sample, OBJECT) for frame, sample in samples.items()}
    findings = [
        *depth_findings(camera, samples),
        *place_findings(f"camera {name}, object", list(bodies.values()), up_sign(up)),
        *hand_findings(camera, samples),
        *reach_findings(camera, samples),
    ]
    departures += [Departure.of_finding(path, one) for one in findings]
    if 0 in bodies:
        departures += obstacle_departures(path, capture.description, bodies[0])
    return departures


def _alone_departures(capture: Capture, name: str, samples: dict[int, Sample]) -> list[Departure]:
    """The camera above the table, and the object in the mask of frame 0 on it, without depth."""
    path, camera, up = capture.folder / CAPTURE, capture.cameras[name], capture.description.up
    departures = alone_departures(path, camera, up)
    if any(d.level == "error" for d in departures) or 0 not in samples:
        return departures
    mask = samples[0].mask
    departures += horizon_departures(path, camera, mask)
    departures += [Departure.of_finding(path, one) for one in size_findings(camera, mask)]
    # Obstacles stand on the table: what lies beneath one is met above it.
    on_table = object_on_table(camera, mask) + np.array([0.0, 0.0, 2 * INSIDE * up_sign(up)])
    return departures + obstacle_departures(path, capture.description, on_table[np.isfinite(on_table[:, 0])])


def obstacle_departures(path: Path, description: Description, points: np.ndarray) -> list[Departure]:
    """Departures of obstacles in which points [n, 3], m, of the object lie in frame 0: nodes there would be thrown out."""
    found = []
    for number, obstacle in enumerate(description.obstacles):
        share = float((obstacle.depth(points) > INSIDE).mean()) if len(points) else 0.0
        if share > INSIDE_SHARE:
            rule = f"the object of frame 0 must be outside, but for {INSIDE_SHARE:.0%} of what is seen of it"
            remedy = "Look at center, rotation and sizes; they are in meters, in the world of the cameras."
            found.append(
                broken(path, f"obstacles[{number}]", f"{rule}. {remedy}", f"{share:.0%} more than {1e3 * INSIDE:g} mm inside")
            )
    return found


def depth_departures(capture: Capture, name: str, medians: list[float]) -> list[Departure]:
    """Departures of a camera whose median depths, m, are not those of a scene on a table."""
    path, depths = capture.folder / CAPTURE, np.array([m for m in medians if np.isfinite(m)])
    if medians and not len(depths):
        return [broken(path, f"cameras.{name}", "some depth is required", "0 in every pixel of every frame")]
    if len(depths) and not NEAR < np.median(depths) < FAR:
        unit = capture.description.depth_unit
        rule = f"the median depth of camera {name} must lie between {NEAR:g} and {FAR:g} m, with the unit of the images"
        return [broken(path, "depth_unit", rule, f"{unit:g} m per count, which makes it {np.median(depths):.4g} m")]
    return []
