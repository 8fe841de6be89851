"""Strips, videos and figures of twins: selects and reads the runs, and rejects invalid options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.data.camera import Camera
from neuspring.data.capture import Capture
from neuspring.data.results import Masks
from neuspring.draw import sheet
from neuspring.draw.film import write_film
from neuspring.draw.painter import DRAWN_MM, Error, distances
from neuspring.draw.scene import VIEW_ELEVATION, chosen_frames
from neuspring.draw.strip import strip_figure
from neuspring.draw.twin import twin_figure
from neuspring.extensions.figures.filmed import FilmedScene, PhotoPainter, PhotoStyle, SplatRun, SurfacePicture
from neuspring.extensions.figures.options import ComparedOptions, FilmOptions, RunOptions, StripOptions, TwinOptions
from neuspring.report.shown import Found, Run, find

PICTURE_ENDINGS, FILM_ENDINGS = (".pdf", ".png", ".jpg", ".svg"), (".mp4", ".gif")


@dataclass(frozen=True, eq=False)
class Chosen:
    """The selected runs and their predictions."""

    found: Found
    runs: list[Run]
    takes: list[SplatRun]
    device: str


def strip(picture: StripOptions) -> None:
    """Draw observed frames on top, each method's prediction and error below -> PDF or PNG."""
    _require_paper(picture)
    chosen = _choose(picture)
    scenario = chosen.found.observations.scenario
    frames = sorted(set(_frames(picture.frames, scenario.frame_count) or chosen_frames(scenario, scenario.frame_count)))
    painter = _painter(picture, chosen, frames, None)
    figure = strip_figure(painter, picture.width)
    width, height = figure.get_size_inches()
    sheet.save(figure, picture.output, picture.dpi)
    print(f"Wrote {picture.output}: {len(frames)} frames, {width:.2f} x {height:.2f} inches, {painter.manner.style}")
    print(f"Caption: {caption(painter)}")


def film(picture: FilmOptions) -> None:
    """Draw a video of observed and predicted frames, side by side -> MP4 or GIF of limited size."""
    require_ending(picture.output, FILM_ENDINGS)
    require_between("--width", picture.width, 160, 1920)
    require_between("--megabytes", picture.megabytes, 1e-3, 100)
    chosen = _choose(picture)
    count = chosen.found.observations.scenario.frame_count
    frames = sorted(set(_frames(picture.frames, count) or range(count)))
    painter = _painter(picture, chosen, frames, "none")
    made = write_film(painter, picture.output, picture.width, picture.megabytes)
    print(f"Wrote {picture.output}: {made}, {painter.manner.style}")


def twin(picture: TwinOptions) -> None:
    """Draw stiffness and regions of twins from any side -> PDF or PNG."""
    _require_paper(picture)
    chosen = _choose(picture, positions=picture.frame > 0)
    _frames([picture.frame], chosen.found.observations.scenario.frame_count, "--frame")
    for take, run in zip(chosen.takes, chosen.runs, strict=True):
        if take.twin is None:
            rule = "must have a twin"
            raise InputError(f"--methods {run.name}", rule, "; ".join(run.notes) or "none", "Select methods with a search.")
        if picture.frame >= len(take.positions):
            rule = f"must be at most {len(take.positions) - 1}, because {run.name} diverged after that frame"
            raise InputError("--frame", rule, picture.frame)
    _without_splats(chosen, picture.style == "splats", "Remove --as splats to draw springs.")
    scene = _scene(picture, chosen, [picture.frame], chosen.takes)
    body = SurfacePicture(
        [(scene, take) for take in chosen.takes],
        picture.frame,
        tuple(dict.fromkeys(picture.by)),
        style=picture.style,
        device=chosen.device,
    )
    sheet.save(twin_figure(body, picture.width), picture.output, picture.dpi)
    print(
        f"Wrote {picture.output}: {', '.join(take.label for take in chosen.takes)}, frame {picture.frame}, "
        f"camera {scene.camera.name}"
    )


def _require_paper(picture: StripOptions | TwinOptions) -> None:
    """Raise InputError for an invalid file or size of a figure."""
    require_ending(picture.output, PICTURE_ENDINGS)
    require_between("--width", picture.width, 1.5, 20)
    require_between("--dpi", picture.dpi, 50, 1200)


def require_ending(path: Path, endings: Sequence[str]) -> None:
    """Raise InputError for an unsupported file extension or a folder, before anything is drawn."""
    if path.suffix.lower() not in endings:
        rule = f"must end in {', '.join(endings[:-1])} or {endings[-1]}"
        raise InputError("--output", rule, path.name, "neuspring draw film writes videos; strip and twin write figures.")
    if path.is_dir():
        raise InputError("--output", "must be a file", f"the folder {path}")
    path.parent.mkdir(parents=True, exist_ok=True)


def require_between(name: str, value: float, least: float, most: float) -> None:
    """Raise InputError for an option that is not finite or outside of its range."""
    if not least <= value <= most:
        raise InputError(name, f"must be {least:g} to {most:g}", value)


def caption(painter: PhotoPainter) -> str:
    """Caption of a strip: its content, and the mean distance of each method over its frames."""
    scene, scenario, manner = painter.scene, painter.scene.observations.scenario, painter.manner
    text = f"{scenario.name}, camera {scene.camera.name}, frames {', '.join(map(str, painter.frames))}"
    text += f"; future from frame {scenario.train_end}."
    text += " Dark: predicted nodes. Blue: observed points. Red: controllers." if manner.style == "nodes" else ""
    if manner.error == "color":
        text += f" Difference: mean absolute color difference of object pixels, 0 to {painter.norm.vmax:g}; hands excluded; PSNR."
    elif manner.error == "distance":
        text += f" Distance of nodes to their observed points, 0 to {painter.norm.vmax:g} mm; gray: not visible."
        means = {take.label: [distances(take, scene.observations, frame)[1].mean() for frame in painter.frames
                              if frame < len(take.positions)] for take in painter.takes}  # fmt: skip
        text += f" Mean: {', '.join(f'{name} {DRAWN_MM * np.mean(own):.1f} mm' for name, own in means.items())}."
    return text


def _choose(a: RunOptions, *, positions: bool = True) -> Chosen:
    """Select and read the runs. Raises InputError."""
    found = find(a.results)
    runs = _named(a, found)
    labels = list(a.labels) or [run.method if len({r.method for r in runs}) == len(runs) else run.name for run in runs]
    if len(labels) != len(runs):
        raise InputError("--labels", f"must have one name for each of {len(runs)} methods", len(labels))
    return Chosen(
        found, runs, [_take(run, label, positions) for run, label in zip(runs, labels, strict=True)], resolve_device(a.device)
    )


def _named(a: RunOptions, found: Found) -> list[Run]:
    """The runs of --methods in order; METHOD selects its first seed. Without --methods, the default runs (`Found.shown`)."""
    names = a.methods or found.shown
    chosen = [run for name in names if (run := next((known for known in found.runs if name in (known.name, known.method)), None))]
    if len(chosen) < len(names):
        rule = f"must be runs in {found.folder}: {', '.join(dict.fromkeys(run.method for run in found.runs))}"
        raise InputError("--methods", rule, ", ".join(a.methods), "Enter METHOD or METHOD/SEED.")
    return chosen


def _take(run: Run, label: str, positions: bool) -> SplatRun:
    if run.trajectory is None or not len(run.trajectory.positions):
        if positions or run.twin is None:
            raise InputError(
                f"--methods {run.name}", "must have a prediction", "; ".join(run.notes) or "none", "Select other runs."
            )
        return SplatRun(label, run.twin.topology.nodes[None], run.twin)
    return SplatRun(label, run.trajectory.positions, run.twin, run.splats, None if run.centers is None else run.centers.positions)


def _frames(wanted: Sequence[int] | None, count: int, option: str = "--frames") -> list[int]:
    beyond = [frame for frame in wanted or () if not 0 <= frame < count]
    if beyond:
        raise InputError(option, f"must be 0 to {count - 1}, the frames of the scenario", ", ".join(map(str, beyond)))
    return list(wanted or ())


def _without_splats(chosen: Chosen, required: bool, remedy: str = "") -> str:
    """The runs without splats, with known reasons; empty if all runs have splats. Raises InputError if they are `required`."""
    without = "; ".join(", ".join([run.name, *run.notes]) for run in chosen.runs if run.splats is None)
    if required and without:
        rule = f"requires {chosen.found.folder / 'appearance'}/<seed>/splats.ply of a scenario with images"
        raise InputError("--as splats", rule, f"none for {without}", remedy)
    return without


def _painter(a: ComparedOptions, chosen: Chosen, frames: list[int], error: Error | None) -> PhotoPainter:
    """The painter of a strip or video; `error` replaces --error best, and None selects the best that can be drawn."""
    without = _without_splats(chosen, a.style == "splats", "Remove --as splats to draw nodes.")
    style = a.style or ("nodes" if without else "splats")
    if without and a.style is None and chosen.found.capture is not None:
        print(f"Drawing nodes, because there are no splats for {without}")
    scene = _scene(a, chosen, frames, chosen.takes)
    comparable = style == "splats" and scene.has_masks
    if a.error == "color" and not comparable:
        received = "nodes" if style == "nodes" else f"camera {scene.camera.name} without photos or masks"
        rule = "requires splats, and photos with masks of the same camera"
        raise InputError("--error color", rule, received, "Use --error distance.")
    require_between("--most", 1.0 if a.most is None else a.most, 1e-6, 1e6)
    manner = PhotoStyle(
        style=style,
        error=(error if a.error == "best" else a.error) or ("color" if comparable else "distance"),
        most=a.most,
    )
    return PhotoPainter(scene, chosen.takes, frames, manner, chosen.device)


def _scene(a: RunOptions, chosen: Chosen, frames: list[int], takes: list[SplatRun]) -> FilmedScene:
    """The scene from the selected camera or view. Raises InputError."""
    found, observations = chosen.found, chosen.found.observations
    cameras = found.capture.cameras if found.capture else {}
    free_view = a.azimuth is not None or a.elevation is not None
    if a.camera is not None and free_view:
        raise InputError("--camera", "cannot be combined with --azimuth and --elevation", a.camera, "Remove one of them.")
    if a.camera is not None and a.camera not in cameras:
        rule = f"must be a camera of the capture ({', '.join(cameras) or 'it has none'})"
        raise InputError("--camera", rule, a.camera, "Use --azimuth and --elevation for other views.")
    if cameras and not free_view:
        camera = cameras[a.camera or next(iter(cameras))]
        return FilmedScene.of(observations, camera, takes, frames, found.capture, _labels(found.folder, found.capture, camera))
    elevation = VIEW_ELEVATION if a.elevation is None else a.elevation
    return FilmedScene.from_side(observations, takes, frames, a.azimuth, elevation)


def _labels(folder: Path, capture: Capture | None, camera: Camera) -> np.ndarray | None:
    """Perceived masks [T, H, W] of the camera; None if the capture provides masks or segmentation has no result."""
    path = folder / "perception" / camera.name / "masks.json"
    if capture is None or capture.description.masks or not path.is_file():
        return None
    labels = Masks.load(StageRecord.load(path).file("masks", path)).labels
    shape = (capture.frame_count, camera.height, camera.width)
    if labels.shape != shape:
        raise InputError(path, f"masks must have the shape of camera {camera.name}, {shape}", labels.shape)
    return labels
