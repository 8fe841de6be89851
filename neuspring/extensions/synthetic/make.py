"""Write the capture folder and the truth of a scene: settle, simulate, certify, place cameras, render, add sensor noise."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.geometry import farthest
from neuspring.core.records import digest_file
from neuspring.core.text import Progress
from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT, Capture, Description, Writer
from neuspring.extensions.synthetic.bodies import SoftBody
from neuspring.extensions.synthetic.fem import Clip, Damping, FiniteElements, VertexBlockDescent, certify, settle
from neuspring.extensions.synthetic.scenes import SCENES, Hand, place
from neuspring.extensions.synthetic.settings import Synthetic
from neuspring.extensions.synthetic.truth import Truth, truth_path
from neuspring.scenes.render import SKIN_COLOR, Part, Renderer, looking, measured, quantized

FRAME_RATE = 30.0
DEPTH_UNIT = 0.001
"""m per count, as in the PhysTwin data."""
FIELD_OF_VIEW = 55.0
"""Degrees, along the width."""
AZIMUTHS = (-35.0, 85.0, 205.0)
"""Directions of the cameras around the object, degrees. The first camera looks at the object's head."""
CAMERA_ELEVATION = 38.0
SENSOR_SEED = 0
"""Seed of the sensor's noise, combined with the scenario's name."""
IMAGE_MARGIN = 0.9
"""The object and the origins of the hands stay within this fraction of the image, measured from its center."""
ANNOTATED_TRACKS = 40
"""Number of tracks for scoring."""
LEAST_JACOBIAN, CRUSHED_SHARE = 0.02, 0.1
"""A clip is rejected if an element falls below this volume ratio in more than this fraction of the frames."""
ENGINES = {"": FiniteElements, "vbd": VertexBlockDescent}
MOST_DEVIATION = 0.001
"""m. A clip is rejected if twice the substeps move the mean node by more than this and CHAOS times the effect of a nudge."""
CHAOS = 3.0
"""If a nudge of the start moves the clip nearly as far, the motion is chaotic, and the time step is not too long."""
GRAINS = {"cloth": (45.0, 0.5), "rope": (70.0, 0.5), "package": (35.0, 0.5)}
"""Frequency, 1/m, and contrast of the fine texture by category."""
PLUSH_GRAIN, HAND_GRAIN = (36.0, 1.1), (45.0, 0.6)


@dataclass(frozen=True)
class CaptureSize:
    """Images and meshes."""

    width: int
    height: int
    mesh: float
    """Spacing of the finite-element nodes of a plush animal, m; other bodies scale it."""
    skin: float
    """Spacing of visible vertices, m."""


SIZES = {
    "tiny": CaptureSize(120, 68, 0.02, 0.008),
    "small": CaptureSize(424, 240, 0.018, 0.004),
    "demo": CaptureSize(424, 240, 0.014, 0.004),
    "full": CaptureSize(848, 480, 0.014, 0.003),
}


def write_capture(row: ScenarioRow, path: Path, config: Config, folder: Path) -> None:
    """See `neuspring.scenes.sources`. Prints the accuracy of the clip."""
    _, truth = make(row, config.section(Synthetic), folder)
    moved = f"{1e3 * truth.certificate:.2g} mm by twice the substeps, {1e3 * truth.sensitivity:.2g} mm by a start 1 um off"
    energy = truth.kinetic[-1] + truth.potential[-1]
    print(f"{row.scenario}: {truth.substeps} substeps per frame; the mean node moves {moved}", flush=True)
    print(f"{row.scenario}: smallest det F {truth.least_jacobian.min():.2f}; final energy {energy:.3f} J", flush=True)


def make(row: ScenarioRow, settings: Synthetic, folder: Path) -> tuple[Capture, Truth]:
    """Write the capture of scene `row.path` to `folder` and its truth next to it, and return both. Deterministic.

    Raises InputError for an unknown scene, and NumericalFailure for a clip that is crushed or not converged.
    """
    engine_name, _, name = row.path.rpartition("/")
    if name not in SCENES or engine_name not in ENGINES:
        rule = f"must be a scene, or vbd/<scene> for the held-out engine; scenes: {sorted(SCENES)}"
        raise InputError(f"scenario {row.scenario}, path", rule, repr(row.path))
    scene, size = SCENES[name], SIZES[settings.size]
    body = scene.body(size.mesh, size.skin)
    frames = min(settings.frames or scene.frames, scene.frames)
    start = settle(body, FRAME_RATE)
    hands = scene.hands(start, scene.frames / FRAME_RATE)
    if engine_name and (body.is_sheet or any(hand.kind == "fist" for hand in hands)):
        rule = "the held-out engine supports only solids that hands grasp, not cloths or pushes"
        raise InputError(f"scenario {row.scenario}, path", rule, repr(row.path))
    engine = ENGINES[engine_name](body, hands, frames, FRAME_RATE, Damping(), start=start)
    clip = engine.run()
    certificate, sensitivity = certify(engine, clip, settings.certified_frames)
    truth = Truth(
        nodes=clip.positions,
        tetrahedra=body.tetrahedra,
        triangles=body.triangles,
        youngs_modulus=body.youngs_modulus,
        membrane=body.membrane,
        surface_nodes=body.surface.nodes,
        surface_weights=body.surface.weights,
        surface_faces=body.surface.faces,
        hand_poses=np.stack([hand.poses(np.arange(frames) / FRAME_RATE) for hand in hands], axis=1),
        held=engine.holder,
        touches=clip.positions[..., 2] < body.radius + 5e-4,
        kinetic=clip.kinetic,
        potential=clip.potential,
        least_jacobian=clip.least_jacobian,
        substeps=clip.substeps,
        certificate=certificate,
        sensitivity=sensitivity,
    )
    _refuse(row.scenario, truth)
    cameras = place_cameras(clip, hands, size)
    description = Description(
        format=1,
        name=row.scenario,
        category=row.category,
        frame_count=frames,
        frame_rate=FRAME_RATE,
        cameras=tuple(camera.entry() for camera in cameras),
        depth_unit=DEPTH_UNIT,
        masks=True,
        provenance={
            "scene": name,
            "engine": engine_name or "semi-implicit",
            "size": settings.size,
            "sensor": settings.sensor,
            "seed": str(SENSOR_SEED),
        },
    )
    writer = Writer(folder, description)
    _film(writer, body, clip, hands, cameras, row, settings, size)
    if scene.marked:
        write_text(folder / "marks.json", json.dumps({"format": 1, "cameras": outlines(writer.capture)}) + "\n")
    path = truth_path(folder)
    truth.save(path)
    return writer.finish(_annotate(truth, cameras[0], writer.capture), truth=f"sha256:{digest_file(path)}"), truth


def _refuse(name: str, truth: Truth) -> None:
    crushed = float((truth.least_jacobian < LEAST_JACOBIAN).mean())
    if crushed > CRUSHED_SHARE:
        raise NumericalFailure(f"{name}: an element is crushed (det F < {LEAST_JACOBIAN}) in {crushed:.0%} of the frames")
    if truth.certificate > max(MOST_DEVIATION, CHAOS * truth.sensitivity):
        deviations = f"{1e3 * truth.certificate:.2f} mm, a start 1 um off by {1e3 * truth.sensitivity:.2f} mm"
        raise NumericalFailure(f"{name}: not converged; twice the substeps move the mean node by {deviations}")


def place_cameras(clip: Clip, hands: Sequence[Hand], size: CaptureSize) -> list[Camera]:
    """Cameras around the object, as near as possible while the moving object and hands stay in the image."""
    focal = 0.5 * size.width / np.tan(np.radians(FIELD_OF_VIEW / 2))
    k = np.array([[focal, 0.0, (size.width - 1) / 2], [0.0, focal, (size.height - 1) / 2], [0.0, 0.0, 1.0]])
    times = np.arange(len(clip.positions)) / FRAME_RATE
    points = np.concatenate([clip.positions[::5, ::7].reshape(-1, 3), *(hand.poses(times)[:, :3] for hand in hands)])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    cameras = []
    for index, azimuth in enumerate(np.radians(AZIMUTHS)):
        up = np.radians(CAMERA_ELEVATION)
        away = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        distance = 0.35
        while True:
            camera = Camera(str(index), size.width, size.height, k, looking(middle + distance * away, middle))
            pixels, depth = camera.project(points)
            off = np.abs(pixels / k[:2, 2] - 1.0).max()
            if (depth > 0.1).all() and off < IMAGE_MARGIN:
                break
            distance += 0.02
        cameras.append(camera)
    return cameras


def _film(
    writer: Writer,
    body: SoftBody,
    clip: Clip,
    hands: Sequence[Hand],
    cameras: Sequence[Camera],
    row: ScenarioRow,
    settings: Synthetic,
    size: CaptureSize,
) -> None:
    frames = len(clip.positions)
    times = np.arange(frames) / FRAME_RATE
    meshes = [hand.mesh(1.5 * size.skin) for hand in hands]
    placed = [place(vertices, hand.poses(times)) for hand, (vertices, _) in zip(hands, meshes, strict=True)]
    skin = body.surface
    parts = [Part(skin.rest, skin.faces, skin.colors, OBJECT, GRAINS.get(row.category, PLUSH_GRAIN))]
    parts += [Part(vertices, faces, np.tile(SKIN_COLOR, (len(vertices), 1)), HANDS, HAND_GRAIN) for vertices, faces in meshes]
    renderer = Renderer(parts)
    surfaces = skin.follow(clip.positions)
    report = Progress(f"render {row.scenario}", frames)
    for frame in range(frames):
        renderer.move([surfaces[frame], *(hand[frame] for hand in placed)])
        for index, camera in enumerate(cameras):
            view = renderer.render(camera)
            rng = np.random.default_rng([SENSOR_SEED, index, frame, *row.scenario.encode()])
            if settings.sensor == "clean":
                depth = quantized(view.depth, DEPTH_UNIT)
            else:
                depth = measured(view.depth, view.slope, DEPTH_UNIT, rng)
            writer.frame(camera.name, frame, view.color, depth, view.label)
        report.update(frame + 1)


MARK_LABELS = {OBJECT: "object", HANDS: "hand"}
BORDER_OFF = 1.0
"""Pixels. Tolerance of an annotation's border, and of the polygon that approximates it."""


def outlines(capture: Capture) -> dict[str, list[dict[str, Any]]]:
    """Polygons around object and hands in frame 0 of each camera, in the format of perception.marks."""
    import cv2

    cameras: dict[str, list[dict[str, Any]]] = {name: [] for name in capture.cameras}
    for name, marks in cameras.items():
        mask = capture.mask(name, 0)
        for label, word in MARK_LABELS.items():
            for contour in cv2.findContours((mask == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
                points = cv2.approxPolyDP(contour, BORDER_OFF, closed=True)[:, 0].tolist()
                # Parts thinner than the tolerance have no polygon.
                kind = "polygon" if len(points) > 2 else "scribble"
                marks.append({"frame": 0, "label": word, "kind": kind, "points": points, "radius": BORDER_OFF})
    return cameras


def _annotate(truth: Truth, camera: Camera, capture: Capture) -> np.ndarray:
    """Tracks [T, K, 3], m, of evenly spread vertices that `camera` sees in frame 0."""
    vertices = truth.surface(0)
    pixels, depth = camera.project(vertices)
    inside = np.flatnonzero(camera.sees(pixels))
    x, y = np.round(pixels[inside]).astype(int).T
    seen = capture.depth(camera.name, 0)[y, x]
    visible = inside[(capture.mask(camera.name, 0)[y, x] == OBJECT) & (np.abs(seen - depth[inside]) < 0.004)]
    spread = visible[farthest(vertices[visible], ANNOTATED_TRACKS)]
    return np.stack([truth.surface(frame)[spread] for frame in range(len(truth.nodes))])
