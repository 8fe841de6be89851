"""The shape of frame 0 that color alone supposes against the truth, by pose: a table of errors, mm.

    python -m workflow.scripts.first_frames [--films FOLDER --nodes FOLDER]

Bodies of the synthetic scenes, and some more, are rendered from eight directions and two heights. FOLDER of --films is that of
`workflow.scripts.footage`, with cameras.json; that of --nodes has CASE/rest.txt, true nodes of frame 0, 0.1 mm. An error is the
mean of two: the mean distance from true nodes to the nearest supposed point, and that from supposed points to the nearest true
node.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import ColorSettings, MarksSegmentation
from neuspring.data.camera import Camera
from neuspring.data.capture import OBJECT
from neuspring.perception.color import FirstFrame
from neuspring.perception.marks.carry import carry
from neuspring.perception.marks.marks import Marks
from neuspring.scenes.synthetic import bodies
from neuspring.scenes.synthetic.make import looking
from neuspring.scenes.synthetic.meshes import Sdf, capsule, ellipsoid, fill, smooth_union, sphere, surface
from neuspring.scenes.synthetic.render import Part, Renderer
from workflow.scripts.footage import film
from workflow.scripts.footage_captures import camera_of
from workflow.scripts.masks import MARKS, Frames

POSES = (None, "lying", "standing")
MESH, SKIN = 0.014, 0.006
"""Spacing of true nodes and of rendered vertices, m."""
ELEVATIONS, AZIMUTHS = (38, 52), range(20, 380, 45)
"""Degrees."""
LAYERS, CELL = 8, 0.006
"""Supposed points along a ray, and the side of the cells of which each keeps one, m."""
Body = tuple[np.ndarray, np.ndarray, np.ndarray]
"""True nodes [N, 3], m; vertices [V, 3] and faces [F, 3] of the skin."""


def box(x: float, y: float, z: float) -> Sdf:
    """A box of these sides on the table."""
    return lambda p: (np.abs(p - (0, 0, z / 2)) - np.array([x, y, z]) / 2).max(axis=-1)


def made(sdf: Sdf) -> Body:
    """A body that is no scene's."""
    low, high = (-0.2, -0.2, -0.02), (0.2, 0.2, 0.34)
    return fill(sdf, low, high, MESH)[0], *surface(sdf, low, high, SKIN)


def animal(make: Callable[[float, float], bodies.SoftBody]) -> Body:
    """A body of the synthetic scenes."""
    body = make(MESH, SKIN)
    return body.nodes, body.surface.rest, body.surface.faces


def turned(body: Body, axis: str) -> Body:
    """A body that was turned by 90 degrees about an axis, on the table."""
    turn = Rotation.from_euler(axis[-1], -90 if axis[0] == "-" else 90, degrees=True)
    nodes, vertices = turn.apply(body[0]), turn.apply(body[1])
    down = (0, 0, vertices[:, 2].min())
    return nodes - down, vertices - down, body[2]


def bear() -> Body:
    """A toy that stands on two legs."""
    parts: list[Sdf] = [ellipsoid((0, 0, 0.12), (0.05, 0.06, 0.065)), sphere((0.01, 0, 0.215), 0.048)]
    for side in (1, -1):
        parts += [capsule((0, 0.03 * side, 0.08), (0.01, 0.04 * side, 0.022), 0.022), sphere((0, 0.035 * side, 0.26), 0.014)]
        parts.append(capsule((0, 0.05 * side, 0.155), (0.03, 0.1 * side, 0.11), 0.017))
    return made(smooth_union(parts, 0.008))


def bottle() -> Body:
    return made(smooth_union([capsule((0, 0, 0.035), (0, 0, 0.14), 0.035), capsule((0, 0, 0.16), (0, 0, 0.22), 0.015)], 0.006))


BODIES: dict[str, Callable[[], Body]] = {
    "sloth, lying": lambda: animal(bodies.sloth),
    "zebra, on its side": lambda: turned(animal(bodies.zebra), "x"),
    "bear, on its back": lambda: turned(bear(), "-y"),
    "bottle, lying": lambda: turned(bottle(), "y"),
    "roll": lambda: made(capsule((-0.12, 0, 0.03), (0.12, 0, 0.03), 0.03)),
    "box, lying": lambda: made(box(0.18, 0.12, 0.08)),
    "ball": lambda: made(sphere((0, 0, 0.06), 0.06)),
    "zebra, standing": lambda: animal(bodies.zebra),
    "dinosaur, sitting": lambda: animal(bodies.dinosaur),
    "bear, standing": bear,
    "bottle, standing": bottle,
    "bag, standing": lambda: made(box(0.2, 0.09, 0.24)),
}
View = tuple[Camera, np.ndarray, np.ndarray, str]
"""Camera, labels [H, W], true nodes [N, 3], m, and up."""


def rendered(body: Body) -> Iterator[View]:
    """A body from all directions, from 0.8 m."""
    nodes, vertices, faces = body
    middle = np.array([*vertices[:, :2].mean(axis=0), 0.05])
    renderer = Renderer([Part(vertices, faces, np.full((len(vertices), 3), 0.5), OBJECT, (40.0, 0.5))])
    renderer.move([vertices])
    intrinsics = np.array([[214.0, 0, 212], [0, 214, 120], [0, 0, 1]])
    for elevation in np.radians(ELEVATIONS):
        for azimuth in np.radians(AZIMUTHS):
            away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
            camera = Camera("0", 424, 240, intrinsics, looking(middle + 0.8 * away, middle))
            yield camera, renderer.render(camera).label, nodes, "+z"


def filmed(films: Path, nodes: Path, case: str) -> View:
    """A real scene, its mask carried from the marks of frame 0."""
    marks = [mark for mark in Marks.load(MARKS / "phystwin_camera0" / f"{case}.json").of("0") if mark.frame == 0]
    labels = carry(Frames(film(films, case, 1)), marks, MarksSegmentation()).labels[0]
    return camera_of(films), labels, np.loadtxt(nodes / case / "rest.txt") / 1e4, "-z"


def error(view: View, pose: str | None) -> float:
    """Of the head of this file, mm."""
    camera, labels, nodes, up = view
    described = SimpleNamespace(category="toy", up_sign=1.0 if up == "+z" else -1.0, pose=pose)
    capture = SimpleNamespace(folder=Path("frame 0"), cameras={"0": camera}, description=described)
    first = FirstFrame.of(capture, labels, ColorSettings())  # type: ignore[arg-type]
    y, x = np.nonzero(first.filled)
    front, back = first.depths(1.0)[y, x], first.depths(0.0)[y, x]
    depth = front[:, None] + (back - front)[:, None] * (np.arange(LAYERS) + 0.5) / LAYERS
    points = camera.lift(np.repeat(np.stack([x, y], axis=1), LAYERS, axis=0).astype(float), depth.ravel())
    points = points[np.unique(np.round(points / CELL), axis=0, return_index=True)[1]]
    there, back_again = cKDTree(points).query(nodes)[0].mean(), cKDTree(nodes).query(points)[0].mean()
    return float(500 * (there + back_again))


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--films", type=Path)
    parser.add_argument("--nodes", type=Path)
    a = parser.parse_args()
    print("| body | pose not given | lying | standing |\n|---|---|---|---|")
    cases = sorted(path.parent.name for path in a.nodes.glob("*/rest.txt")) if a.films and a.nodes else []
    views = {f"`{case}`, real": lambda case=case: [filmed(a.films, a.nodes, case)] for case in cases}
    views |= {name: lambda make=make: list(rendered(make())) for name, make in BODIES.items()}
    for name, make in views.items():
        each = make()
        errors = [np.mean([error(view, pose) for view in each]) for pose in POSES]
        print(f"| {name} | " + " | ".join(f"{value:.1f}" for value in errors) + " |", flush=True)


if __name__ == "__main__":
    main()
