"""A run as it is drawn: nodes, springs and hands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from neuspring.core.artifacts import Twin
from neuspring.play.colors import OVER, Scale, Springs, linear, node_colors
from neuspring.play.dress import Dress
from neuspring.report.figures.views import sample

if TYPE_CHECKING:
    import viser

NODE, HAND = (70, 90, 120), (214, 39, 40)
GRABBED = (255, 200, 0)
WIDTH = 2.0
"""Pixels of a spring."""
SIZE = 0.3
"""Radius of a node as a part of the median distance to its nearest neighbor."""
LEAST, REACH = 0.004, 0.03
"""Least radius of a node, and of what takes the mouse for it, as parts of the body's size."""


class Body:
    """One run in the scene. `offset` [3], m, moves it aside."""

    def __init__(self, scene: viser.SceneApi, name: str, twin: Twin | None, nodes: np.ndarray, hands: np.ndarray) -> None:
        self.twin, self.name, self._scene = twin, name, scene
        self.parts = Springs.of(twin, sample(len(twin.topology.springs))) if twin and len(twin.topology.springs) else None
        self.root = scene.add_frame(f"/{name}", show_axes=False)
        size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        self.radius = radius = max(SIZE * spacing(nodes), LEAST * size)
        self._reach = max(radius, REACH * size)
        self.dress: Dress | None = None
        self._handles: Any = None
        self.nodes = _balls(scene, f"/{name}/nodes", nodes, radius, node_colors(twin) if twin else NODE)
        self.hands = _balls(scene, f"/{name}/hands", hands, 1.3 * radius, HAND)
        self.springs: Any = None
        if self.parts is not None:
            ends = self.parts.ends(nodes, hands)
            colors = np.zeros(ends.shape, np.uint8)
            self.springs = scene.add_line_segments(f"/{name}/springs", ends, colors, thickness=WIDTH, thickness_units="screen")
        self.label = scene.add_label(f"/{name}/label", name, anchor="bottom-center", font_screen_scale=0.9)

    @property
    def left_out(self) -> int:
        """How many springs are not drawn."""
        return len(self.twin.topology.springs) - len(self.parts.pairs) if self.twin and self.parts else 0

    def show(self, *, nodes: bool, springs: bool, hands: bool, splats: bool = False) -> None:
        """Which parts are seen."""
        self.nodes.visible, self.hands.visible = nodes, hands
        if self.springs is not None:
            self.springs.visible = springs
        if self.dress is not None:
            self.dress.show(splats)

    def move(self, nodes: np.ndarray, hands: np.ndarray, quantity: str, scale: Scale | None, most: float = np.inf) -> np.ndarray:
        """Draw nodes [N, 3] and hands [C, 3], m; springs stretched beyond `most` are red. Returns the strain of drawn springs."""
        self.nodes.batched_positions = np.asarray(nodes, np.float32)
        self.hands.batched_positions = np.asarray(hands, np.float32)
        if self._handles is not None:
            self._handles.batched_positions = np.asarray(nodes, np.float32)
        self.label.position = (*nodes.mean(axis=0)[:2], float(nodes[:, 2].max()) + 0.02)
        if self.parts is None:
            return np.zeros(0)
        ends = self.parts.ends(nodes, hands)
        strain = self.parts.strain(ends)
        if self.springs.visible:
            colors = self.parts.paint(quantity, scale, strain)
            colors[strain > most] = OVER
            self.springs.points = ends
            self.springs.colors = np.repeat(linear(colors)[:, None], 2, axis=1)
        return strain

    def mark(self, node: int | None) -> None:
        """Show a grabbed node in yellow."""
        colors = node_colors(self.twin) if self.twin else np.tile(np.array(NODE, np.uint8), (len(self.nodes.batched_positions), 1))
        if node is not None:
            colors = colors.copy()
            colors[node] = GRABBED
        self.nodes.batched_colors = linear(colors)

    def handles(self) -> Any:
        """Unseen balls about the nodes, large enough to be hit with a mouse."""
        if self._handles is None:
            places = self.nodes.batched_positions
            self._handles = _balls(self._scene, f"/{self.name}/handles", places, self._reach, NODE, opacity=0.0)
        return self._handles

    def remove(self) -> None:
        """Take it out of the scene."""
        self.root.remove()


def spacing(nodes: np.ndarray) -> float:
    """Median distance of a node to its nearest neighbor, m; 0.01 for one node."""
    from scipy.spatial import cKDTree

    if len(nodes) < 2:
        return 0.01
    return max(float(np.median(cKDTree(nodes).query(nodes, k=2)[0][:, 1])), 1e-4)


def _balls(scene: viser.SceneApi, name: str, centers: np.ndarray, radius: float, colors: Any, opacity: float | None = None) -> Any:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    turns = np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(centers), 1))
    return scene.add_batched_meshes_simple(
        name,
        ball.vertices,
        ball.faces,
        turns,
        np.asarray(centers, np.float32),
        batched_colors=linear(np.asarray(colors, np.uint8)),
        opacity=opacity,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
    )
