"""Training of splats on the views of frame 0: Adam, one view per step, more harmonics in stages, adaptive density.

Density adapts after Kerbl et al. 2023, section 5.2: a splat whose place in the picture has a mean gradient above a threshold is too
coarse. Small ones are cloned, large ones split; faint and huge ones go. The other steps are those of the released appearance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.text import Progress
from neuspring.splats.losses import REFERENCE_WIDTH, Shot, loss
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterize import Backend, Rendered
from neuspring.splats.view import C0, rotations

SCALE_NEIGHBORS = 3
"""The first scale of a splat is its mean distance to this many neighbors."""
FIRST_OPACITY = 0.1
RESET_OPACITY, RESET_EVERY = 0.01, 3000
"""Steps between two resets of all opacities to at most this."""
DEGREE_EVERY = 1000
"""Steps after which the degree of the harmonics in use rises by one; it starts from 0."""
POSITION_RATE_END, POSITION_STEPS = 1.6e-6, 30_000
"""Learning rate of means after so many steps, per extent; log-linear before."""
ROTATION_RATE = 1e-3
DENSIFY_FROM, DENSIFY_UNTIL, DENSIFY_EVERY = 500, 15_000, 100
"""Steps between which splats are cloned, split and pruned, and steps between two rounds of it, as released."""
DENSIFY_GRADIENT = 2e-4
"""Least mean gradient of a splat's place in the picture, per half picture, for which it is cloned or split."""
SPLIT_SIZE = 0.01
"""Size, as part of the extent, above which a splat is split; smaller ones are cloned."""
MOST_SPLATS = 300_000
PRUNE_OPACITY = 0.005
"""Splats below it are removed."""
PRUNE_RADIUS, PRUNE_SIZE = 20.0, 0.1
"""After the first reset of opacities, splats are removed whose radius ever exceeded so many pixels, or this part of the extent."""
RECORD_EVERY = 10
"""Steps between entries of the history."""
LEAST_FIRST_SCALE = 1e-6
"""m: least first scale."""
ADAM_EPSILON = 1e-15
MOMENTS = ("exp_avg", "exp_avg_sq")
CHILDREN = 2
SHRINK = 1.6
"""A child of a split is smaller than its parent by this factor."""


@dataclass(frozen=True)
class TrainedSplats:
    """Splats and the history of their training."""

    splats: Splats
    history: dict[str, list[float]]
    """Columns step, loss, splats."""
    first: int
    """Number of splats at the start."""


def first_splats(points: np.ndarray, colors: np.ndarray, settings: Appearance, width: float) -> Splats:
    """Splats at points [P, 3], m, with RGB [P, 3]; a pixel is `width` wide at the object, m. Raises InputError for less than 4."""
    if settings.spacing and len(points):
        cells = np.floor((points - points.min(axis=0)) / (settings.spacing * width)).astype(np.int64)
        _, owner, members = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        owner = owner.reshape(-1)
        sums = [np.bincount(owner, weights=values) / members for values in (*points.T, *colors.T)]
        points, colors = np.stack(sums[:3], axis=1), np.stack(sums[3:], axis=1)
    if len(points) <= SCALE_NEIGHBORS:
        rule = f"more than {SCALE_NEIGHBORS} points are needed to begin with"
        raise InputError("appearance, points of frame 0", rule, len(points))
    scale = np.maximum(cKDTree(points).query(points, k=SCALE_NEIGHBORS + 1)[0][:, 1:].mean(axis=1), LEAST_FIRST_SCALE)
    if settings.fixed_radius is not None:
        scale = np.full(len(points), settings.fixed_radius)
    count = len(points)
    shades = np.zeros((count, (settings.degree + 1) ** 2, 3))
    shades[:, 0] = (colors - 0.5) / C0
    return Splats(
        means=points.astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.log(scale)[:, None],
        opacity_logits=np.full(count, math.log(FIRST_OPACITY / (1 - FIRST_OPACITY))),
        harmonics=shades,
    )


def extent_of(shots: Sequence[Shot]) -> float:
    """1.1 times the largest distance of a camera from their mean, m; for a single camera, its distance to the object."""
    if len(shots) == 1:
        measured = shots[0].depth[shots[0].depth > 0]
        return float(measured.median()) if len(measured) else 1.0
    centers = torch.stack([shot.view.position for shot in shots])
    return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())


def train(start: Splats, shots: Sequence[Shot], settings: Appearance, seed: int, backend: Backend) -> TrainedSplats:
    """Fit splats to the shots. Deterministic on the CPU for a seed.

    Raises NumericalFailure if splats become infinite or all of them are removed.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = _Optimizer(Gaussians.of(start, str(shots[0].view.intrinsics.device)), settings, extent_of(shots))
    statistics = Statistics.empty(optimizer.gaussians.means)
    history: dict[str, list[float]] = {"step": [], "loss": [], "splats": []}
    progress = Progress("appearance", settings.iterations)
    # Splats that the last step adds would not be trained.
    last_change = min(DENSIFY_UNTIL, settings.iterations)
    for step, shot in zip(range(1, settings.iterations + 1), _shuffled(shots, generator), strict=False):
        optimizer.schedule(step)
        rendered = optimizer.gaussians.draw(shot.view, degree=(step - 1) // DEGREE_EVERY, backend=backend)
        value = loss(rendered, shot, settings)
        number = float(value.detach())
        value.backward()  # type: ignore[no-untyped-call]
        if step < DENSIFY_UNTIL:
            statistics.add(rendered, shot.view.width, shot.view.height)
        optimizer.step()
        optimizer.require_usable(step)
        if step % RECORD_EVERY == 0 or step == settings.iterations:
            for name, entry in {"step": step, "loss": number, "splats": len(optimizer)}.items():
                history[name].append(float(entry))
        if DENSIFY_FROM < step < last_change and step % DENSIFY_EVERY == 0:
            splats, after_reset = vars(optimizer.gaussians), step > RESET_EVERY
            stay, added = densify(splats, statistics, settings, optimizer.extent, after_reset, generator)
            optimizer.replace(stay, added)
            optimizer.require_usable(step)
            statistics = Statistics.empty(optimizer.gaussians.means)
        if step % RESET_EVERY == 0 and step < last_change:
            optimizer.reset_opacities()
        progress.update(step, f"loss {number:.4f}, {len(optimizer)} splats")
    return TrainedSplats(optimizer.gaussians.stored(), history, len(start.means))


def _shuffled(shots: Sequence[Shot], generator: torch.Generator) -> Iterator[Shot]:
    while True:
        for index in torch.randperm(len(shots), generator=generator).tolist():
            yield shots[index]


@dataclass(frozen=True, kw_only=True)
class SplatRates(Appearance):
    """The settings with the learning rates of the released training."""

    position_rate: float = 1.6e-4
    """Learning rate of means at the start, per extent of the scene: 1.1 times the largest distance of a camera from the center of
    all."""
    color_rate: float = 2.5e-3
    """Learning rate of the first harmonic; that of the others is a twentieth."""
    scale_rate: float = 5e-3
    """Learning rate of log scales."""


class _Optimizer:
    """Adam over the tensors of `Gaussians`, whose number may change."""

    def __init__(self, gaussians: Gaussians, settings: Appearance, extent: float) -> None:
        settings = SplatRates(**vars(settings))
        self.settings, self.extent = settings, extent
        values = _parameters(vars(gaussians))
        rates = {
            "means": settings.position_rate * extent,
            "quaternions": ROTATION_RATE,
            "log_scales": 0.0 if settings.fixed_radius else settings.scale_rate,
            "opacity_logits": settings.opacity_rate,
            "base": settings.color_rate,
            "bands": settings.color_rate / 20,
        }
        self._values = {name: tensor.clone().requires_grad_() for name, tensor in values.items()}
        groups = [{"params": [tensor], "lr": rates[name], "name": name} for name, tensor in self._values.items()]
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPSILON)

    def __len__(self) -> int:
        """Number of splats."""
        return len(self._values["means"])

    @property
    def gaussians(self) -> Gaussians:
        """The splats as they are now."""
        values = dict(self._values)
        return Gaussians(harmonics=torch.cat([values.pop("base"), values.pop("bands")], dim=1), **values)

    def schedule(self, step: int) -> None:
        """Lower the learning rate of the means, log-linearly."""
        done = min(step / POSITION_STEPS, 1.0)
        rate = math.exp((1 - done) * math.log(self.settings.position_rate) + done * math.log(POSITION_RATE_END))
        self._adam.param_groups[0]["lr"] = rate * self.extent

    def step(self) -> None:
        """Move all tensors against their gradients."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def require_usable(self, step: int) -> None:
        """Raise NumericalFailure for splats that cannot be rendered."""
        if not len(self._values["means"]):
            raise NumericalFailure(f"appearance: step {step} removed the last splat")
        bad = [name for name, tensor in self._values.items() if not torch.isfinite(tensor.detach()).all()]
        # Infinite scales have finite logarithms.
        if bad or not torch.isfinite(torch.exp(self._values["log_scales"].detach())).all():
            raise NumericalFailure(f"appearance: after step {step} splats are not finite ({', '.join(bad) or 'scales'})")

    def replace(self, stay: torch.Tensor, added: dict[str, torch.Tensor]) -> None:
        """Leave the splats `stay` [N] bool with their moments, append others without."""
        new = _parameters(added)
        for group in self._adam.param_groups:
            name, old = group["name"], group["params"][0]
            tensor = torch.cat([old.detach()[stay], new[name]]).requires_grad_()
            state = self._adam.state.pop(old, None)
            if state:
                moments = {key: torch.cat([state[key][stay], torch.zeros_like(new[name])]) for key in MOMENTS}
                self._adam.state[tensor] = state | moments
            group["params"][0] = self._values[name] = tensor

    @torch.no_grad()
    def reset_opacities(self) -> None:
        """Dim all splats, so that those that no picture needs stay dim and are removed."""
        tensor = self._values["opacity_logits"]
        tensor.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in MOMENTS:
            self._adam.state[tensor][moment].zero_()


def _parameters(splats: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The tensors that Adam trains. The first harmonic learns faster than the others, so it is a parameter of its own."""
    shades = splats["harmonics"]
    others = {name: tensor for name, tensor in splats.items() if name != "harmonics"}
    return others | {"base": shades[:, :1], "bands": shades[:, 1:]}


@dataclass
class Statistics:
    """Statistics of each splat in the pictures since their number last changed."""

    pull: torch.Tensor
    """[N] sum of gradients of the place in the picture, per half picture."""
    seen: torch.Tensor
    """[N] number of pictures that show it."""
    radius: torch.Tensor
    """[N] largest, as a part of the picture's width."""

    @classmethod
    def empty(cls, like: torch.Tensor) -> Statistics:
        """Statistics of no pictures, for splats with means `like` [N, 3]."""
        return cls(like.new_zeros(len(like)), like.new_zeros(len(like)), like.new_zeros(len(like)))

    @torch.no_grad()
    def add(self, rendered: Rendered, width: int, height: int) -> None:
        """Account for a picture after its backward pass."""
        if (gradient := rendered.means.grad) is None:
            return
        if rendered.backend == "gsplat":
            gradient = gradient[0, rendered.index]
        half = gradient.new_tensor([width / 2, height / 2])
        self.pull.index_add_(0, rendered.index, (gradient * half).norm(dim=1))
        self.seen.index_add_(0, rendered.index, torch.ones_like(rendered.radii))
        self.radius[rendered.index] = torch.maximum(self.radius[rendered.index], rendered.radii / width)


@torch.no_grad()
def densify(
    splats: Mapping[str, torch.Tensor],
    statistics: Statistics,
    settings: Appearance,
    extent: float,
    after_reset: bool,
    generator: torch.Generator,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The splats that stay [N] bool, and the new ones, with the keys of `splats` (those of `Gaussians`).

    `extent`, m, is the size of the scene; `after_reset` also removes splats that are huge.
    """
    size = torch.exp(splats["log_scales"]).amax(1)
    mean_pull = statistics.pull / statistics.seen.clamp_min(1)
    coarse = mean_pull > DENSIFY_GRADIENT
    room = max(MOST_SPLATS - len(size), 0)
    # The coarsest ones first where there is no room for all.
    if int(coarse.sum()) > room:
        coarse = torch.zeros_like(coarse).index_fill_(0, torch.topk(mean_pull, room).indices, True) & coarse
    # A split makes smaller splats, so splats of a fixed radius are cloned.
    split = coarse & (size > SPLIT_SIZE * extent) & (settings.fixed_radius is None)
    added = {name: tensor[coarse & ~split] for name, tensor in splats.items()}
    if split.any():
        children = {name: tensor[split].repeat_interleave(CHILDREN, 0) for name, tensor in splats.items()}
        noise = torch.randn(children["means"].shape, generator=generator).to(children["means"])
        offsets = noise * torch.exp(children["log_scales"])
        children["means"] = children["means"] + torch.einsum("nij,nj->ni", rotations(children["quaternions"]), offsets)
        children["log_scales"] = children["log_scales"] - torch.log(size.new_tensor(SHRINK))
        added = {name: torch.cat([added[name], children[name]]) for name in added}
    gone = split | _superfluous(splats, settings, extent, after_reset)
    if after_reset and settings.fixed_radius is None:
        gone |= statistics.radius > PRUNE_RADIUS / REFERENCE_WIDTH
    stay = ~_superfluous(added, settings, extent, after_reset)
    return ~gone, {name: tensor[stay] for name, tensor in added.items()}


def _superfluous(splats: Mapping[str, torch.Tensor], settings: Appearance, extent: float, after_reset: bool) -> torch.Tensor:
    """Faint splats [N], after a reset also huge ones."""
    faint = torch.sigmoid(splats["opacity_logits"]) < PRUNE_OPACITY
    if not after_reset or settings.fixed_radius:
        return faint
    return faint | (torch.exp(splats["log_scales"]).amax(1) > PRUNE_SIZE * extent)
