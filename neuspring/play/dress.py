"""Splats on a twin, as the browser draws them: the nodes of the shown frame carry them from frame 0, in one step.

One step instead of one from frame to frame, as for pictures (splats/skinning.py), so that any frame can be shown after any other.
Of the color only the part is shown that does not depend on the direction.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neuspring.core.artifacts import SplatCenters
from neuspring.splats.harmonics import C0
from neuspring.splats.model import Splats
from neuspring.splats.skinning import Skin

if TYPE_CHECKING:
    import viser

UNIT = 1e-3
"""m. The browser has covariances in 16-bit floats, which are too coarse for squares of meters."""
WIDEST = 200.0
"""Largest standard deviation, mm: the largest whose square 16 bits hold, less a margin."""
MOST_SPLATS = 60_000
"""Splats that are drawn: 32 bytes each go to the browser in each frame."""


class Dress:
    """The splats of one run in the scene, made in the frame in which the nodes are at `nodes` [N, 3], m."""

    def __init__(
        self, scene: viser.SceneApi, name: str, splats: Splats, nodes: np.ndarray, centers: SplatCenters | None = None
    ) -> None:
        chosen = np.arange(len(splats.means))
        if len(chosen) > MOST_SPLATS:
            chosen = np.sort(np.random.default_rng(0).choice(chosen, MOST_SPLATS, replace=False))
        self.left_out = len(splats.means) - len(chosen)
        self._nodes, self._centers, self._chosen = np.array(nodes, np.float32), centers, chosen
        self._means, self._turns = torch.tensor(splats.means[chosen]), torch.tensor(splats.quaternions[chosen])
        scales = np.exp(splats.log_scales[chosen].astype(float)) / UNIT
        self._scales = np.minimum(np.broadcast_to(scales, (len(chosen), 3)), WIDEST).astype(np.float32)
        colors = np.clip(0.5 + C0 * splats.harmonics[chosen, 0], 0, 1)
        opacities = 1 / (1 + np.exp(-splats.opacity_logits[chosen, None]))
        self._skin = Skin(self._nodes, frozen=True)
        self.handle: Any = scene.add_gaussian_splats(
            f"/{name}/splats",
            (self._means.numpy() / UNIT).astype(np.float32),
            covariances(self._turns.numpy(), self._scales),
            colors,
            opacities,
            scale=UNIT,
            visible=False,
        )

    @property
    def shown(self) -> bool:
        """Whether they are seen."""
        return bool(self.handle.visible)

    def show(self, visible: bool) -> None:
        """Let them be seen, or not."""
        if self.handle.visible != visible:
            self.handle.visible = visible

    def placed(self, nodes: np.ndarray, frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Centers [G, 3], m, and quaternions [G, 4] with the nodes at [N, 3], m; a model's own centers in its frames."""
        if self._centers is not None and frame is not None:
            means = self._centers.positions[min(frame, len(self._centers.positions) - 1)][self._chosen]
            return np.asarray(means), np.asarray(self._turns.numpy())
        means, turns = self._skin.step(self._nodes, np.asarray(nodes, np.float32), self._means, self._turns)
        return means.numpy(), turns.numpy()

    def move(self, nodes: np.ndarray, frame: int | None = None) -> None:
        """Draw them with the nodes at [N, 3], m, if they are seen."""
        if not self.shown:
            return
        means, turns = self.placed(nodes, frame)
        handle = self.handle
        handle.set_gaussians(means / UNIT, covariances(turns, self._scales), handle.rgbs / 255.0, handle.opacities / 255.0)


def covariances(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """R diag(s^2) R^T [G, 3, 3] of quaternions [G, 4], w first, of any length but zero, and standard deviations [G, 3]."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    half = np.array(rows).transpose(2, 0, 1) * scales[:, None]
    return np.asarray(half @ half.transpose(0, 2, 1), np.float32)
