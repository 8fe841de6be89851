"""Layers of the scene: a run's body, its splats, its tracks, and what was observed around it."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.visual.material import PBRMaterial

from neuspring.core.artifacts import Observations, SplatCenters, Twin
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.draw.sheet import sample
from neuspring.extensions.play.colors import OVER_COLOR, Scale, Springs, linear, node_colors
from neuspring.splats.model import Splats
from neuspring.splats.skinning import Skin
from neuspring.splats.view import C0
from neuspring.twin.body import lines_of

if TYPE_CHECKING:
    import viser

NODE_COLOR, HAND_COLOR, GRABBED_COLOR = (70, 90, 120), (214, 39, 40), (255, 200, 0)
SEEN_COLOR, TRACK_COLOR, CAMERA_COLOR = (0, 150, 90), (150, 0, 200), (60, 60, 60)
PREDICTED_COLOR, APART_COLOR = (230, 120, 0), (90, 90, 90)
NOT_SEEN_COLOR = (150, 150, 150)
UNSEEN_REACH = 3.5
"""Distance from all points that were seen, in median distances between them, from which nobody saw a part of the body. Of points
that are spread at random over a surface, one in a thousand places is farther from its nearest point."""
LINE_WIDTH = 2.0
"""Pixels of a spring, and of the line from a predicted point to the annotated one."""
SIZE = 0.3
"""Radius of a node as a part of the median distance to its nearest neighbor."""
LEAST_RADIUS, LEAST_REACH = 0.004, 0.03
"""Least radius of a node, and of what takes the mouse for it, as parts of the body's size."""
SPLAT_UNIT = 1e-3
"""m. The browser has covariances in 16-bit floats, which are too coarse for squares of meters."""
WIDEST_SPLAT = 200.0
"""Largest standard deviation of a splat, mm: the largest whose square 16 bits hold, less a margin."""
MOST_DRAWN_SPLATS = 60_000
"""Splats that are drawn: 32 bytes each go to the browser in each frame."""
FRUSTUM = 0.12
"""Length of a camera's pyramid as a part of the scene's size."""
LARGEST_IMAGE = 480
"""Pixels: larger images are made smaller before they are sent."""


@dataclass
class Display:
    """Parts that are shown, and their look."""

    quantity: str = "stiffness"
    splats: bool = True
    nodes: bool = False
    springs: bool = False
    hands: bool = False
    points: bool = False
    tracks: bool = False
    cameras: bool = False
    images: bool = False
    gap: float = 1.2
    """Distance between runs, as a part of the scene's size; 0: all in one place."""
    runs: list[str] = field(default_factory=list)
    """Their names."""


class BodyLayer:
    """The nodes, springs and hands of a run."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        twin: Twin | None,
        nodes: np.ndarray,
        hands: np.ndarray,
        seen: np.ndarray | None = None,
    ) -> None:
        """Nodes that lie far from all points `seen` [m, 3] in frame 0 are gray."""
        self.twin, self.name, self._scene = twin, name, scene
        count = len(lines_of(twin).pairs) if twin else 0
        self.parts = Springs.of(twin, sample(count)) if twin and count else None
        self.root = scene.add_frame(f"/{name}", show_axes=False)
        size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        self.radius = radius = max(SIZE * spacing(nodes), LEAST_RADIUS * size)
        self._reach = max(radius, LEAST_REACH * size)
        self.splats: SplatLayer | None = None
        self.overlay: TrackOverlay | None = None
        self._handles: Any = None
        self._colors = node_colors(twin) if twin else np.tile(np.array(NODE_COLOR, np.uint8), (len(nodes), 1))
        # Live twins may start in another frame.
        self._colors[unseen(twin.topology.nodes if twin else nodes, seen)] = NOT_SEEN_COLOR
        self.nodes = _balls(scene, f"/{name}/nodes", nodes, radius, self._colors)
        self.hands = _balls(scene, f"/{name}/hands", hands, 1.3 * radius, HAND_COLOR)
        self.springs: Any = None
        if self.parts is not None:
            ends = self.parts.ends(nodes, hands)
            colors = np.zeros(ends.shape, np.uint8)
            self.springs = scene.add_line_segments(f"/{name}/springs", ends, colors, thickness=LINE_WIDTH, thickness_units="screen")
        self.label = scene.add_label(f"/{name}/label", name, anchor="bottom-center", font_screen_scale=0.9)

    @property
    def left_out(self) -> int:
        """Number of springs that are not drawn."""
        return len(self.parts.lines.pairs) - len(self.parts.pairs) if self.parts else 0

    def show(self, display: Display) -> None:
        """Show the parts that are wanted; nodes and springs in place of splats that it lacks."""
        bare = display.splats and self.splats is None
        self.nodes.visible, self.hands.visible = display.nodes or bare, display.hands
        if self.springs is not None:
            self.springs.visible = display.springs or bare
        if self.splats is not None:
            self.splats.show(display.splats)
        if self.overlay is not None:
            self.overlay.show(display.tracks)

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
            colors[strain > most] = OVER_COLOR
            self.springs.points = ends
            self.springs.colors = np.repeat(linear(colors)[:, None], 2, axis=1)
        return strain

    def mark(self, node: int | None) -> None:
        """Show a grabbed node in yellow."""
        colors = self._colors.copy()
        if node is not None:
            colors[node] = GRABBED_COLOR
        self.nodes.batched_colors = linear(colors)

    def handles(self) -> Any:
        """Unseen balls about the nodes, large enough to be hit with a mouse.

        All their pixels are cut out (alpha mask): what is merely transparent would hide the splats behind it.
        """
        if self._handles is None:
            places = self.nodes.batched_positions
            ball = trimesh.creation.icosphere(subdivisions=1, radius=self._reach)
            unseen = PBRMaterial(baseColorFactor=(0, 0, 0, 0), alphaMode="MASK", alphaCutoff=0.5)
            ball.visual = trimesh.visual.TextureVisuals(material=unseen)
            turns = np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(places), 1))
            make = functools.partial(self._scene.add_batched_glb, lod="off", cast_shadow=False, receive_shadow=False)
            self._handles = make(f"/{self.name}/handles", ball.export(file_type="glb"), turns, places)
        return self._handles

    def remove(self) -> None:
        """Take it out of the scene."""
        self.root.remove()


def unseen(points: np.ndarray, seen: np.ndarray | None) -> np.ndarray:
    """True for points [n, 3] far from all that were seen in the same frame [m, 3], m; none is where that is not known."""
    if seen is None:
        return np.zeros(len(points), bool)
    return np.asarray(cKDTree(seen).query(points)[0] > UNSEEN_REACH * spacing(seen))


def spacing(nodes: np.ndarray) -> float:
    """Median distance of a node to its nearest neighbor, m; 0.01 for one node."""
    if len(nodes) < 2:
        return 0.01
    return max(float(np.median(cKDTree(nodes).query(nodes, k=2)[0][:, 1])), 1e-4)


def _balls(scene: viser.SceneApi, name: str, centers: np.ndarray, radius: float, colors: Any) -> Any:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    turns = np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(centers), 1))
    return scene.add_batched_meshes_simple(
        name,
        ball.vertices,
        ball.faces,
        turns,
        np.asarray(centers, np.float32),
        batched_colors=linear(np.asarray(colors, np.uint8)),
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
    )


class SplatLayer:
    """The splats of one run, made in the frame in which the nodes are at `nodes` [N, 3], m.

    The nodes of the shown frame carry them from that frame in one step, instead of from frame to frame as for pictures
    (splats/skinning.py), so that any frame can be shown after any other. Of the color only the part is shown that does not depend
    on the direction. Those farther than UNSEEN_REACH from all points `seen` [m, 3] in that frame are gray.
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
        chosen = np.arange(len(splats.means))
        if len(chosen) > MOST_DRAWN_SPLATS:
            chosen = np.sort(np.random.default_rng(0).choice(chosen, MOST_DRAWN_SPLATS, replace=False))
        self._nodes, self._centers, self._chosen = np.array(nodes, np.float32), centers, chosen
        self._means, self._turns = torch.tensor(splats.means[chosen]), torch.tensor(splats.quaternions[chosen])
        scales = np.exp(splats.log_scales[chosen].astype(float)) / SPLAT_UNIT
        self._scales = np.minimum(np.broadcast_to(scales, (len(chosen), 3)), WIDEST_SPLAT).astype(np.float32)
        colors = np.clip(0.5 + C0 * splats.harmonics[chosen, 0], 0, 1)
        # Half their own light: a plain gray would show no shape.
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

    @property
    def shown(self) -> bool:
        """True where they are shown."""
        return bool(self.handle.visible)

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        if self.handle.visible != visible:
            self.handle.visible = visible

    def carried(self, nodes: np.ndarray, frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Centers [G, 3], m, and quaternions [G, 4] with the nodes at [N, 3], m; a model's own centers in its frames."""
        if self._centers is not None and frame is not None:
            means = self._centers.positions[min(frame, len(self._centers.positions) - 1)][self._chosen]
            return np.asarray(means), np.asarray(self._turns.numpy())
        means, turns = self._skin.step(self._nodes, np.asarray(nodes, np.float32), self._means, self._turns)
        return means.numpy(), turns.numpy()

    def move(self, nodes: np.ndarray, frame: int | None = None) -> None:
        """Draw them with the nodes at [N, 3], m, if they are seen."""
        if self.shown:
            means, turns = self.carried(nodes, frame)
            old = self.handle
            old.set_gaussians(means / SPLAT_UNIT, covariances(turns, self._scales), old.rgbs / 255.0, old.opacities / 255.0)


def covariances(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """R diag(s^2) R^T [G, 3, 3] of quaternions [G, 4], w first, of any length but zero, and standard deviations [G, 3]."""
    half = Rotation.from_quat(quaternions, scalar_first=True).as_matrix() * scales[:, None]
    return np.asarray(half @ half.transpose(0, 2, 1), np.float32)


class TrackOverlay:
    """Annotated tracks against what a run predicts of them: the node of the track error, and how far off it is.

    The tracks [T, K, 3] are those annotated in frame 0, in the body `name` whose nodes are at `nodes` [N, 3] there, m.
    """

    def __init__(self, scene: viser.SceneApi, name: str, tracks: np.ndarray, nodes: np.ndarray, radius: float) -> None:
        known = np.isfinite(tracks[0]).all(axis=1) if len(tracks) else np.zeros(0, bool)
        self._tracks = tracks[:, known] if len(tracks) else np.zeros((1, 0, 3))
        self._nodes = cKDTree(nodes).query(self._tracks[0])[1].astype(int)
        self._points = _points(scene, f"/{name}/tracks", nodes[self._nodes], PREDICTED_COLOR, radius, "diamond")
        lines = np.zeros((len(self._nodes), 2, 3), np.float32)
        self._lines = scene.add_line_segments(f"/{name}/apart", lines, APART_COLOR, thickness=LINE_WIDTH, thickness_units="screen")
        self.error: float | None = None
        """Mean distance in the frame that is shown, m; None where no track is annotated."""

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        self._points.visible = self._lines.visible = visible

    def move(self, nodes: np.ndarray, frame: int) -> None:
        """Show a frame with nodes [N, 3], m."""
        annotated = self._tracks[min(frame, len(self._tracks) - 1)]
        seen = np.isfinite(annotated).all(axis=1)
        pairs = np.stack([nodes[self._nodes][seen], annotated[seen]], axis=1).astype(np.float32)
        self.error = float(np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1).mean()) if len(pairs) else None
        if self._points.visible:
            self._points.points, self._lines.points = pairs[:, 0], pairs


def _points(scene: viser.SceneApi, name: str, points: np.ndarray, color: Any, size: float, shape: Any) -> Any:
    return scene.add_point_cloud(name, points, np.array(color, np.uint8), point_size=size, point_shape=shape, precision="float32")


class Surroundings:
    """Observations of one scenario: points, annotated tracks, and cameras with their images."""

    def __init__(self, scene: viser.SceneApi, observations: Observations, capture: Capture | None, size: float) -> None:
        self._seen, self._capture = observations, capture
        radius = min(0.35 * spacing(observations.object_points[0]), 0.006 * size)
        self.points = _points(scene, "/observed/points", self._observed(0), SEEN_COLOR, radius, "circle")
        self.tracks = _points(scene, "/observed/tracks", self._annotated(0), TRACK_COLOR, 1.4 * radius, "diamond")
        self._images = False
        self.cameras: dict[str, Any] = {}
        for name, camera in (capture.cameras if capture else {}).items():
            self.cameras[name] = scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=float(2 * np.arctan2(camera.height / 2, camera.intrinsics[1, 1])),
                aspect=camera.width / camera.height,
                scale=FRUSTUM * size,
                color=CAMERA_COLOR,
                thickness=1.5,
                thickness_units="screen",
                wxyz=Rotation.from_matrix(camera.camera_to_world[:3, :3]).as_quat(scalar_first=True),
                position=camera.camera_to_world[:3, 3],
            )

    def show(self, display: Display, hidden: bool) -> None:
        """Show the parts that are wanted; while they are hidden, cameras alone, without images."""
        self.points.visible, self.tracks.visible = display.points and not hidden, display.tracks and not hidden
        images = display.images and display.cameras and not hidden
        for camera in self.cameras.values():
            camera.visible = display.cameras
            if self._images and not images:
                camera.image = None
        self._images = images

    def move(self, frame: int) -> None:
        """Show a frame."""
        if self.points.visible:
            self.points.points = self._observed(frame)
        if self.tracks.visible:
            self.tracks.points = self._annotated(frame)
        if self._images:
            for name, camera in self.cameras.items():
                camera.image = self._image(name, frame)

    def _observed(self, frame: int) -> np.ndarray:
        return np.asarray(self._seen.object_points[frame][self._seen.object_visibility[frame]])

    def _annotated(self, frame: int) -> np.ndarray:
        tracks = self._seen.tracks[frame] if len(self._seen.tracks) else np.zeros((0, 3), np.float32)
        return np.asarray(tracks[np.isfinite(tracks).all(axis=1)])

    def _image(self, name: str, frame: int) -> np.ndarray | None:
        """A small picture, or none where the camera has none."""
        assert self._capture is not None
        if frame >= self._capture.frame_count or not self._capture.has(name, frame):
            return None
        try:
            image = self._capture.color(name, frame)
        except InputError:
            return None
        factor = LARGEST_IMAGE / max(image.shape[:2])
        return image if factor >= 1 else cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
