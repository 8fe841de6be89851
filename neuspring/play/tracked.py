"""Annotated tracks against what a run predicts of them: the node that the track error is made of, and how far off it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    import viser

PREDICTED, APART = (230, 120, 0), (90, 90, 90)
WIDTH = 2.0
"""Pixels of the line from a predicted point to the annotated one."""


class Tracked:
    """The tracks [T, K, 3] that are annotated in frame 0, in the body `name` whose nodes are at `nodes` [N, 3] there, m."""

    def __init__(self, scene: viser.SceneApi, name: str, tracks: np.ndarray, nodes: np.ndarray, radius: float) -> None:
        known = np.isfinite(tracks[0]).all(axis=1) if len(tracks) else np.zeros(0, bool)
        self._tracks = tracks[:, known] if len(tracks) else np.zeros((1, 0, 3))
        self._nodes = cKDTree(nodes).query(self._tracks[0])[1].astype(int)
        self._points = scene.add_point_cloud(
            f"/{name}/tracks",
            nodes[self._nodes],
            np.array(PREDICTED, np.uint8),
            point_size=radius,
            point_shape="diamond",
            precision="float32",
        )
        lines = np.zeros((len(self._nodes), 2, 3), np.float32)
        self._lines = scene.add_line_segments(f"/{name}/apart", lines, APART, thickness=WIDTH, thickness_units="screen")
        self.error: float | None = None
        """Mean distance in the frame that is shown, m; None where no track is annotated."""

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        self._points.visible = self._lines.visible = visible

    def move(self, nodes: np.ndarray, frame: int) -> None:
        """Show a frame with nodes [N, 3], m."""
        annotated = self._tracks[min(frame, len(self._tracks) - 1)]
        seen = np.isfinite(annotated).all(axis=1)
        predicted = nodes[self._nodes][seen]
        pairs = np.stack([predicted, annotated[seen]], axis=1).astype(np.float32)
        self.error = float(np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1).mean()) if len(pairs) else None
        if self._points.visible:
            self._points.points, self._lines.points = pairs[:, 0], pairs
