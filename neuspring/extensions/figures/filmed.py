"""Drawing of runs with the capture's images: nodes over photos, splats, color differences, and surfaces of twins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Observations
from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.draw.painter import ERROR_COLORS, DrawingStyle, Painter, empty, hands
from neuspring.draw.scene import ShownRun, ShownScene, box_around, shown_points
from neuspring.draw.twin import Quantity, TwinPicture
from neuspring.scores.pictures import Pair, psnr
from neuspring.splats.draw import frames_from_centers, picture, skinned_frames, view_of
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterize import choose_backend
from neuspring.splats.view import C0

Style = Literal["splats", "nodes"]


@dataclass(frozen=True, eq=False)
class SplatRun(ShownRun):
    """The prediction of a run with its splats, if any."""

    splats: Splats | None = None
    centers: np.ndarray | None = None
    """Centers [F, G, 3], m, of the splats, predicted by the method itself; None: the nodes carry the splats."""

    def gaussians(self, frames: Iterable[int], device: str) -> Iterator[tuple[int, Gaussians]]:
        """Yield the splats of these frames in ascending order; frames after a divergence are skipped."""
        assert self.splats is not None
        selected = {frame for frame in frames if frame < len(self.positions)}
        stop = max(selected, default=-1) + 1
        if self.centers is None:
            every = skinned_frames(self.splats, self.positions[:stop], device) if stop else iter(())
        else:
            every = frames_from_centers(self.splats, self.centers[:stop], device)
        return ((frame, gaussians) for frame, gaussians in enumerate(every) if frame in selected)


@dataclass(frozen=True, eq=False)
class FilmedScene(ShownScene):
    """The observed scene with images and masks, if the camera is a camera of the capture."""

    capture: Capture | None = None
    labels: np.ndarray | None = None
    """Perceived masks [T, H, W] of the camera, if the capture does not provide masks."""

    @classmethod
    def of(
        cls,
        observations: Observations,
        camera: Camera,
        takes: Sequence[ShownRun],
        frames: Sequence[int],
        capture: Capture | None = None,
        labels: np.ndarray | None = None,
    ) -> FilmedScene:
        """The scene, cut to the part of the camera's image with all content of these frames."""
        pixels, depth = camera.project(shown_points(observations, takes, frames))
        seen, last = pixels[depth > 0], [camera.width - 1, camera.height - 1]
        seen = seen if len(seen) else np.array([[0.0, 0.0], last])
        seen = seen if capture is None else np.clip(seen, 0, last)
        return cls(observations, camera, box_around(seen, camera, clip=capture is not None), capture, labels)

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """The shown part of an image [H, W, ...]."""
        left, top, right, bottom = self.box
        return picture[top:bottom, left:right]

    def photo(self, frame: int) -> np.ndarray | None:
        """The whole photo of a frame, RGB [H, W, 3] uint8; None if there is none."""
        if self.capture is None or not self.capture.has(self.camera.name, frame):
            return None
        return self.capture.color(self.camera.name, frame)

    def mask(self, frame: int) -> np.ndarray | None:
        """Labels [H, W] of the whole photo of a frame; None if there are none."""
        if self.capture is None or not self.capture.has(self.camera.name, frame):
            return None
        if self.capture.description.masks:
            return self.capture.mask(self.camera.name, frame)
        return None if self.labels is None else self.labels[frame]

    @property
    def has_masks(self) -> bool:
        """True if the scene has masks, so that observed and predicted images can be compared."""
        return self.capture is not None and (self.capture.description.masks or self.labels is not None)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A prediction as splats in one frame, cut to the shown part of the image."""

    rgba: np.ndarray
    """Splats [h, w, 4] uint8, over black."""
    difference: np.ndarray | None = None
    """Mean absolute color difference [h, w] of colors 0 to 1; NaN where neither image shows the object; None: no comparison."""
    hands: np.ndarray | None = None
    psnr: float = float("nan")
    """PSNR of the whole image, dB, as in the tables."""


@dataclass(frozen=True, kw_only=True)
class PhotoStyle(DrawingStyle):
    """Style in which predictions are drawn: splats on white, or nodes over a pale photo."""

    style: Style


class PhotoPainter(Painter):
    """Draws photos, predictions as splats or as nodes over the photo, and color differences."""

    scene: FilmedScene
    manner: PhotoStyle
    takes: Sequence[SplatRun]

    def __init__(
        self, scene: FilmedScene, takes: Sequence[SplatRun], frames: Sequence[int], manner: PhotoStyle, device: str
    ) -> None:
        super().__init__(scene, takes, frames, manner)
        self._drawn = [self._splats(take, device) if manner.style == "splats" else {} for take in takes]
        if manner.error == "color":
            self.error_name, self.error_label = "difference", "color difference"

    def _splats(self, take: SplatRun, device: str) -> dict[int, Drawn]:
        view, backend = view_of(self.scene.camera, device), choose_backend("auto", device)
        made = {}
        for frame, gaussians in take.gaussians(self.frames, device):
            rgba = picture(gaussians, view, backend)
            made[frame] = self._compared(rgba, frame) if self.manner.error == "color" else Drawn(self.scene.cut(rgba))
        return made

    def _compared(self, rgba: np.ndarray, frame: int) -> Drawn:
        photo, labels = self.scene.photo(frame), self.scene.mask(frame)
        if photo is None or labels is None:
            return Drawn(self.scene.cut(rgba))
        pair = Pair.of(photo, rgba, labels)
        difference = (pair.truth - pair.prediction).abs().mean(0).numpy()
        shows = pair.silhouettes[0] | pair.silhouettes[1]
        cut = self.scene.cut
        part = cut(np.where(shows & ~pair.hands, difference, np.nan))
        return Drawn(cut(rgba), part, cut(pair.hands), float(psnr(pair.prediction, pair.truth)))

    def draw_observed(self, axis: Axes, frame: int) -> None:
        """Draw the photo, or the observed points if there is no photo."""
        photo, labels = self.scene.photo(frame), self.scene.mask(frame)
        if photo is not None:
            empty(axis, self.scene.view)
            self._image(axis, photo if self.manner.style == "nodes" or labels is None else masked(photo, labels))
            return
        super().draw_observed(axis, frame)
        if self.scene.capture is not None:
            self._note(axis, f"camera {self.scene.camera.name}: no image")

    def draw_predicted(self, axis: Axes, which: int, frame: int) -> None:
        """Draw the prediction as splats, or as nodes over a pale photo or the observed points."""
        if self.manner.style == "nodes" or frame >= len(self.takes[which].positions):
            super().draw_predicted(axis, which, frame)
            return
        empty(axis, self.scene.view)
        self._image(axis, over_white(self._drawn[which][frame].rgba), cut=False)

    def draw_error(self, axis: Axes, which: int, frame: int) -> None:
        """Draw the error in false colors, and write the PSNR or the mean distance."""
        if self.manner.error != "color":
            super().draw_error(axis, which, frame)
            return
        empty(axis, self.scene.view)
        if frame < len(self.takes[which].positions):
            self._difference(axis, self._drawn[which][frame])

    def _below(self, axis: Axes, frame: int) -> None:
        if (photo := self.scene.photo(frame)) is None:
            super()._below(axis, frame)
        else:
            self._image(axis, faded(photo))

    def _difference(self, axis: Axes, drawn: Drawn) -> None:
        if drawn.difference is None or drawn.hands is None:
            self._note(axis, "no image")
            return
        ground = np.full((*drawn.hands.shape, 3), 255, np.uint8)
        ground[drawn.hands] = 200
        self._image(axis, ground, cut=False)
        shape = drawn.hands.shape
        axis.imshow(drawn.difference, cmap=ERROR_COLORS, norm=self.norm, extent=_extent(shape), interpolation="nearest")
        self._note(axis, f"{drawn.psnr:.1f} dB" if np.isfinite(drawn.psnr) else "equal")

    def _image(self, axis: Axes, rgb: np.ndarray, *, cut: bool = True) -> None:
        shown = self.scene.cut(rgb) if cut else rgb
        axis.imshow(shown, extent=_extent(shown.shape), interpolation="antialiased")


def _extent(shape: Sequence[int]) -> tuple[float, float, float, float]:
    return (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)


@dataclass(frozen=True, eq=False)
class SurfacePicture(TwinPicture):
    """Twins as springs, or as the surface of their splats."""

    style: Literal["springs", "splats"] = "springs"
    device: str = "cpu"

    def paint(self, axis: Axes, scene: ShownScene, take: ShownRun, quantity: Quantity) -> None:
        """Draw one panel."""
        if self.style == "springs":
            super().paint(axis, scene, take, quantity)
            return
        assert isinstance(scene, FilmedScene)
        assert isinstance(take, SplatRun)
        empty(axis, scene.view, framed=False)
        extent = _extent((scene.view.height, scene.view.width))
        axis.imshow(over_white(self._surface(scene, take, quantity)), extent=extent, aspect="auto", interpolation="antialiased")
        hands(axis, scene, self.frame)

    def _surface(self, scene: FilmedScene, take: SplatRun, quantity: Quantity) -> np.ndarray:
        """The splats [h, w, 4] over black, each with the color of the surface node nearest in frame 0."""
        assert take.splats is not None
        outer = take.positions[0][: scene.observations.surface_count]
        nearest = cKDTree(outer).query(take.splats.means)[1]
        rgb = self.node_colors(take, quantity)[nearest, :3]
        (gaussians,) = (splats for _, splats in take.gaussians([self.frame], self.device))
        plain = torch.tensor((rgb - 0.5) / C0, dtype=torch.float32, device=self.device)[:, None]
        painted = replace(gaussians, harmonics=plain)
        # The image is not compared with a photo, so it may have more pixels than the camera.
        view = view_of(finer(scene.view, 900), self.device)
        return picture(painted, view, choose_backend("auto", self.device))


def finer(camera: Camera, least: int) -> Camera:
    """The same view with more pixels, at least `least` wide; pixel centers remain at integer coordinates."""
    factor = max(math.ceil(least / camera.width), 1)
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= factor
    # The image extends by half a pixel beyond the outer pixel centers, before and after scaling.
    intrinsics[:2, 2] += 0.5 * (factor - 1)
    return replace(camera, width=factor * camera.width, height=factor * camera.height, intrinsics=intrinsics)


FADE = 0.6
"""Fraction of white in a photo behind nodes."""


def over_white(rgba: np.ndarray) -> np.ndarray:
    """Composite an image rendered over black [H, W, 4] onto white: RGB [H, W, 3] uint8."""
    return np.asarray(np.clip(rgba[..., :3] + (255.0 - rgba[..., 3:]) + 0.5, 0, 255), np.uint8)


def masked(photo: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The photo with white outside of object and hands."""
    picture = photo.copy()
    picture[~np.isin(labels, (OBJECT, HANDS))] = 255
    return picture


def faded(photo: np.ndarray) -> np.ndarray:
    """A pale gray photo as background of nodes."""
    gray = photo.astype(float).mean(axis=2, keepdims=True)
    return np.asarray(np.repeat((1 - FADE) * gray + FADE * 255, 3, axis=2), np.uint8)
