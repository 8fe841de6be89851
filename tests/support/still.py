"""Films of still bodies of known shape, seen by cameras around them."""

import numpy as np

from neuspring.data.camera import CameraEntry
from neuspring.data.capture import HANDS, OBJECT, Writer
from neuspring.data.results import LiftedTracks, Masks, ShapePrior
from neuspring.perception.sample import inside
from neuspring.scenes.render import Part, Renderer, looking, quantized
from neuspring.scenes.shapes import sphere, surface
from tests.support.captures import FRAMES, K, describe
from tests.support.filmed import rows

SIZE = (120, 68)


def still(
    folder,
    body,
    box,
    eyes,
    target,
    *,
    scale=1,
    hand=None,
):
    """Capture, masks, the cloud that the cameras saw, and the truth. Images are `scale` times SIZE; a ball at `hand` is a hand."""
    vertices, faces = surface(body, *box, 0.004)
    parts, moved = [Part(vertices, faces, np.full((len(vertices), 3), 0.5), OBJECT, (30.0, 0.3))], [vertices]
    if hand is not None:
        ball, ball_faces = surface(sphere((0, 0, 0), 0.02), (-0.03,) * 3, (0.03,) * 3, 0.004)
        parts.append(Part(ball, ball_faces, np.full((len(ball), 3), 0.5), HANDS, (30.0, 0.3)))
        moved.append(ball + np.array(hand))
    renderer = Renderer(parts)
    renderer.move(moved)
    intrinsics = rows(np.diag([float(scale), float(scale), 1.0]) @ K)
    width, height = (scale * side for side in SIZE)
    poses = [rows(looking(np.array(eye), np.array(target))) for eye in eyes]
    entries = tuple(
        CameraEntry(name=str(k), width=width, height=height, intrinsics=intrinsics, camera_to_world=pose)
        for k, pose in enumerate(poses)
    )
    writer = Writer(folder, describe(cameras=entries))
    cloud, masks = [], {}
    for name, camera in writer.capture.cameras.items():
        view = renderer.render(camera)
        for frame in range(FRAMES):
            writer.frame(name, frame, view.color, quantized(view.depth, 0.001), view.label)
        y, x = np.nonzero(view.label == OBJECT)
        cloud.append(camera.lift(np.stack([x, y], axis=1).astype(float), view.depth[y, x].astype(float)))
        masks[name] = Masks(labels=np.repeat(view.label[None], FRAMES, axis=0), backend="given")
    return writer.finish(), masks, np.concatenate(cloud), ShapePrior(vertices=vertices, faces=faces, backend="truth")


def overlap(first, second):
    """Intersection over union of the volumes of two shapes, from random points around the first."""
    low, high = first.vertices.min(axis=0) - 0.02, first.vertices.max(axis=0) + 0.02
    low, high = np.minimum(low, second.vertices.min(axis=0)), np.maximum(high, second.vertices.max(axis=0))
    points = np.random.default_rng(0).uniform(low, high, (20000, 3))
    a, b = inside(first, points), inside(second, points)
    return float((a & b).sum() / (a | b).sum())


def tracked(points, frames=FRAMES):
    """Lifted tracks of points [n, 3] that stand still, beside one controller."""
    count = len(points)
    return LiftedTracks(
        object_points=np.repeat(points[None], frames, axis=0),
        object_visibility=np.ones((frames, count), bool),
        object_motion_valid=np.ones((frames, count), bool),
        object_colors=np.zeros((count, 3)),
        controller_points=np.zeros((frames, 1, 3)),
        cloud=points,
        cloud_colors=np.zeros((count, 3)),
        backend="x",
    )
