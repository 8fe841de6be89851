"""A scenario of `played.results` with splats and a video of them, and what paints it: for tests of pictures for papers."""

import numpy as np

from neuspring.core.artifacts import Observations
from neuspring.data.camera import CameraEntry
from neuspring.data.capture import HANDS, OBJECT, Capture, Description, Writer
from neuspring.draw.scene import broad_side, seen_from, shown_points
from neuspring.extensions.figures.filmed import FilmedScene, PhotoPainter, PhotoStyle, SplatRun
from neuspring.report.shown import find
from neuspring.splats.draw import OBJECT_COVERAGE, picture, view_of
from tests.support.filmed import rows
from tests.support.played import dressed, results

SIZE = 96
"""Width and height of the video, pixels."""
CORNER = 12
"""Side of a square that the masks call a hand, in the upper left corner, pixels."""
METHODS = ("baseline", "neuspring")


def takes(scenario):
    """The runs of a scenario: that of METHODS[0] moves as the object does."""
    found = {run.method: run for run in find([scenario]).runs}
    return [SplatRun(name, found[name].trajectory.positions, found[name].twin, found[name].splats) for name in METHODS]


def observed(scenario):
    return Observations.load(scenario / "observations.npz")


def filmed(folder, missing=()):
    """A scenario whose video shows the splats as the first method moves them, over black, with exact masks."""
    scenario = results(folder, METHODS)
    dressed(scenario)
    seen, take = observed(scenario), takes(scenario)[0]
    count, up = seen.scenario.frame_count, seen.scenario.up
    points = shown_points(seen, [take], range(count))
    large = seen_from(points, up, broad_side(points, up), 25.0)
    k = large.intrinsics.copy()
    k[:2] *= SIZE / large.width
    k[:2, 2] = (SIZE - 1) / 2
    entry = CameraEntry(
        name="0", width=SIZE, height=SIZE, intrinsics=rows(k), camera_to_world=rows(large.camera_to_world), missing=missing
    )
    facts = {"format": 1, "name": "small", "category": "rope", "frame_count": count, "frame_rate": seen.scenario.frame_rate}
    writer = Writer(scenario / "capture", Description(**facts, cameras=(entry,), train_end=seen.scenario.train_end, masks=True))
    view = view_of(writer.capture.cameras["0"], "cpu")
    for frame, gaussians in take.gaussians(range(count), "cpu"):
        if frame in missing:
            continue
        rgba = picture(gaussians, view, "warp")
        labels = np.where(rgba[..., 3] >= OBJECT_COVERAGE, OBJECT, 0).astype(np.uint8)
        labels[:CORNER, :CORNER] = HANDS
        # What is at the border, where a pixel is partly object, counts as object and keeps its color.
        writer.frame("0", frame, rgba[..., :3], np.ones((SIZE, SIZE), np.uint16), labels)
    writer.finish()
    return scenario


def painter(scenario, frames, **manner):
    """Painter of a scenario, from the camera of its video if it has one."""
    seen, shown = observed(scenario), takes(scenario)
    if (scenario / "capture").is_dir():
        capture = Capture.load(scenario / "capture")
        scene = FilmedScene.of(seen, capture.cameras["0"], shown, frames, capture)
    else:
        points = shown_points(seen, shown, frames)
        scene = FilmedScene.of(seen, seen_from(points, seen.scenario.up, 250.0, 20.0), shown, frames)
    plain = {"style": "nodes", "error": "distance"}
    return PhotoPainter(scene, shown, frames, PhotoStyle(**(plain | manner)), "cpu")
