"""Layers of the scene: nodes, springs, controllers and splats of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.visual.material import PBRMaterial

from neuspring.core.artifacts import SplatCenters, Twin
from neuspring.draw.sheet import sample
from neuspring.extensions.play.colors import Scale, linear
from neuspring.extensions.play.simulator import hands_of
from neuspring.splats.model import Splats
from neuspring.splats.skinning import Skin
from neuspring.splats.view import C0
from neuspring.twin.body import lines_of

if TYPE_CHECKING:
    import viser

NODE_COLOR, HAND_COLOR, GRABBED_COLOR, NOT_SEEN_COLOR = (70, 90, 120), (214, 39, 40), (255, 200, 0), (150, 150, 150)
UNSEEN_REACH = 3.5
"""Distance from all observed points, in median distances between them, beyond which a part of the object counts as unseen. With
random points on a surface, one location in a thousand is farther from its nearest point."""
SPLAT_UNIT = 1e-3
"""Unit of splats, m: the browser uses 16-bit floats for covariances, which are too coarse for square meters."""
WIDEST_SPLAT = 200.0
"""Largest standard deviation of a splat, mm; its square must fit into 16 bits."""
MOST_DRAWN_SPLATS = 60_000
"""Largest number of drawn splats; each sends 32 bytes per frame to the browser."""


class BodyLayer:
    """Nodes, springs and controllers of a run, with a label per hand, and its splats if it has any."""

    def __init__(self, scene: viser.SceneApi, name: str, twin: Twin | None, nodes: np.ndarray, hands: np.ndarray) -> None:
        self.name, self._scene = name, scene
        self.lines = lines_of(twin) if twin else None
        self._chosen = sample(len(self.lines.pairs)) if self.lines else slice(None)
        self.root = scene.add_frame(f"/{name}", show_axes=False)
        size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        radius = max(0.3 * spacing(nodes), 0.004 * size)
        self._reach = max(radius, 0.03 * size)
        self.splats: SplatLayer | None = None
        self._handles: Any = None
        self.nodes = _balls(scene, f"/{name}/nodes", nodes, radius, np.tile(NODE_COLOR, (len(nodes), 1)))
        self.hands = _balls(scene, f"/{name}/hands", hands, 1.3 * radius, HAND_COLOR)
        _, first = np.unique(hands_of(hands, hands[:0]), return_index=True)
        self._hand_labels = {index: scene.add_label(f"/{name}/hands/{index}", "hand") for index in first}
        self.springs: Any = None
        if self.lines is not None and len(self.lines.pairs):
            ends = self._ends(nodes, hands)
            self.springs = scene.add_line_segments(
                f"/{name}/springs", ends, np.zeros(ends.shape, np.uint8), thickness=2.0, thickness_units="screen"
            )
        self.label = scene.add_label(f"/{name}/label", name, anchor="bottom-center", font_screen_scale=0.9)

    @property
    def stiffness(self) -> np.ndarray:
        """Stiffness of the drawn springs [S], N."""
        return np.zeros(0) if self.lines is None else self.lines.stiffness[self._chosen]

    def show(self, springs: bool, splats: bool) -> None:
        """Show or hide springs (with nodes and controllers) and splats. A run without splats always shows its springs."""
        bare = springs or self.splats is None
        self.nodes.visible = self.hands.visible = bare
        if self.springs is not None:
            self.springs.visible = bare
        if self.splats is not None and self.splats.handle.visible != splats:
            self.splats.handle.visible = splats

    def paint(self, scale: Scale) -> None:
        """Color the springs by stiffness."""
        if self.springs is not None:
            self.springs.colors = np.repeat(linear(scale.paint(self.stiffness))[:, None], 2, axis=1)

    def move(self, nodes: np.ndarray, hands: np.ndarray) -> None:
        """Draw nodes [N, 3] and controllers [C, 3], m."""
        self.nodes.batched_positions = np.asarray(nodes, np.float32)
        self.hands.batched_positions = np.asarray(hands, np.float32)
        for index, label in self._hand_labels.items():
            label.position = hands[index]
        if self._handles is not None:
            self._handles.batched_positions = np.asarray(nodes, np.float32)
        self.label.position = (*nodes.mean(axis=0)[:2], float(nodes[:, 2].max()) + 0.02)
        if self.springs is not None and self.springs.visible:
            self.springs.points = self._ends(nodes, hands)

    def mark(self, node: int) -> None:
        """Color a grabbed node yellow; -1: none."""
        colors = np.tile(np.array(NODE_COLOR, np.uint8), (len(self.nodes.batched_positions), 1))
        if node >= 0:
            colors[node] = GRABBED_COLOR
        self.nodes.batched_colors = linear(colors)

    def handles(self) -> Any:
        """Add invisible balls around the nodes, large enough to hit with the mouse.

        An alpha mask removes their pixels, because transparent balls would hide the splats behind them.
        """
        positions = self.nodes.batched_positions
        ball = trimesh.creation.icosphere(subdivisions=1, radius=self._reach)
        clear = PBRMaterial(baseColorFactor=(0, 0, 0, 0), alphaMode="MASK", alphaCutoff=0.5)
        ball.visual = trimesh.visual.TextureVisuals(material=clear)
        look: dict[str, Any] = {"lod": "off", "cast_shadow": False, "receive_shadow": False}
        content = ball.export(file_type="glb")
        self._handles = self._scene.add_batched_glb(f"/{self.name}/handles", content, _still(len(positions)), positions, **look)
        return self._handles

    def remove(self) -> None:
        """Remove the run from the scene."""
        self.root.remove()

    def _ends(self, nodes: np.ndarray, hands: np.ndarray) -> np.ndarray:
        """Ends of the drawn springs [S, 2, 3] float32, m."""
        assert self.lines is not None
        return np.asarray(self.lines.points(nodes, hands).astype(np.float32)[self.lines.pairs[self._chosen]])


def unseen(points: np.ndarray, seen: np.ndarray | None) -> np.ndarray:
    """True for points [n, 3] far from all observed points of the same frame [m, 3], m; False for all if `seen` is None."""
    if seen is None:
        return np.zeros(len(points), bool)
    return np.asarray(cKDTree(seen).query(points)[0] > UNSEEN_REACH * spacing(seen))


def spacing(nodes: np.ndarray) -> float:
    """Median distance of a node from its nearest neighbor, m; 0.01 for a single node."""
    if len(nodes) < 2:
        return 0.01
    return max(float(np.median(cKDTree(nodes).query(nodes, k=2)[0][:, 1])), 1e-4)


def _still(count: int) -> np.ndarray:
    return np.tile(np.array([1.0, 0, 0, 0], np.float32), (count, 1))


def _balls(scene: viser.SceneApi, name: str, centers: np.ndarray, radius: float, colors: Any) -> Any:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    positions, look = np.asarray(centers, np.float32), linear(np.asarray(colors, np.uint8))
    options: dict[str, Any] = {"batched_colors": look, "lod": "off", "cast_shadow": False, "receive_shadow": False}
    return scene.add_batched_meshes_simple(name, ball.vertices, ball.faces, _still(len(positions)), positions, **options)


class SplatLayer:
    """Splats of one run, defined in the frame with nodes at `nodes` [N, 3], m.

    Skinning moves them from that frame to the shown frame in one step, so that frames can be shown in any order; for renders it
    proceeds from frame to frame (splats/skinning.py). View-dependent colors are omitted. Splats farther than UNSEEN_REACH from
    all points `seen` [m, 3] of that frame are gray.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        splats: Splats,
        nodes: np.ndarray,
        centers: SplatCenters | None = None,
        seen: np.ndarray | None = None,
    ) -> None:
        chosen = sample(len(splats.means), MOST_DRAWN_SPLATS)
        self._nodes, self._centers, self._chosen = np.array(nodes, np.float32), centers, chosen
        self._means, self._turns = torch.tensor(splats.means[chosen]), torch.tensor(splats.quaternions[chosen])
        scales = np.exp(splats.log_scales[chosen].astype(float)) / SPLAT_UNIT
        self._scales = np.minimum(np.broadcast_to(scales, (len(chosen), 3)), WIDEST_SPLAT).astype(np.float32)
        colors = np.clip(0.5 + C0 * splats.harmonics[chosen, 0], 0, 1)
        # Keeps half of their brightness, because a constant gray would hide the shape.
        hidden = unseen(splats.means[chosen], seen)
        colors[hidden] = 0.5 * (np.array(NOT_SEEN_COLOR) / 255 + colors[hidden].mean(axis=1, keepdims=True))
        opacities = 1 / (1 + np.exp(-splats.opacity_logits[chosen, None]))
        self._skin = Skin(self._nodes, frozen=True)
        self.handle: Any = scene.add_gaussian_splats(
            f"/{name}/splats",
            (self._means.numpy() / SPLAT_UNIT).astype(np.float32),
            covariances(self._turns.numpy(), self._scales),
            colors,
            opacities,
            scale=SPLAT_UNIT,
            visible=False,
        )

    def carried(self, nodes: np.ndarray, frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Centers [G, 3], m, and quaternions [G, 4] for nodes [N, 3], m; with `frame`, the model's own centers if it has any."""
        if self._centers is not None and frame is not None:
            means = self._centers.positions[min(frame, len(self._centers.positions) - 1)][self._chosen]
            return np.asarray(means), np.asarray(self._turns.numpy())
        means, turns = self._skin.step(self._nodes, np.asarray(nodes, np.float32), self._means, self._turns)
        return means.numpy(), turns.numpy()

    def move(self, nodes: np.ndarray, frame: int | None = None) -> None:
        """Draw the splats for nodes [N, 3], m, if they are visible."""
        if self.handle.visible:
            means, turns = self.carried(nodes, frame)
            old = self.handle
            old.set_gaussians(means / SPLAT_UNIT, covariances(turns, self._scales), old.rgbs / 255.0, old.opacities / 255.0)


def covariances(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Covariances R diag(s^2) R^T [G, 3, 3] from nonzero quaternions [G, 4], w first, and standard deviations s [G, 3]."""
    half = Rotation.from_quat(quaternions, scalar_first=True).as_matrix() * scales[:, None]
    return np.asarray(half @ half.transpose(0, 2, 1), np.float32)
