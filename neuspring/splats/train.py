"""Training of splats on the views of frame 0: Adam, one view per step, increasing degree of harmonics, adaptive density.

Density follows Kerbl et al. 2023, section 5.2. A splat is too coarse if the mean gradient of its image position is above a
threshold: small splats are cloned, large splats are split. Faint and huge splats are removed. All else follows PhysTwin's
released training.
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
"""The initial scale of a splat is its mean distance to this many neighbors."""
FIRST_OPACITY = 0.1
RESET_OPACITY, RESET_EVERY = 0.01, 3000
"""Maximum opacity after a reset, and steps between two resets."""
DEGREE_EVERY = 1000
"""Steps between increments of the degree of the harmonics, which starts at 0."""
POSITION_RATE_END, POSITION_STEPS = 1.6e-6, 30_000
"""Final learning rate of means per extent, and the steps of its log-linear decay."""
ROTATION_RATE = 1e-3
DENSIFY_FROM, DENSIFY_UNTIL, DENSIFY_EVERY = 500, 15_000, 100
"""First and last step, and interval, of cloning, splitting and pruning, as in PhysTwin's release."""
DENSIFY_GRADIENT = 2e-4
"""Minimum mean gradient of a splat's image position, in half images, for cloning or splitting it."""
SPLIT_SIZE = 0.01
"""Splats above this size, as a fraction of the extent, are split; smaller splats are cloned."""
MOST_SPLATS = 300_000
PRUNE_OPACITY = 0.005
"""Splats with a lower opacity are removed."""
PRUNE_RADIUS, PRUNE_SIZE = 20.0, 0.1
"""Maximum radius of a splat, px, and maximum size as a fraction of the extent, both from the first reset of opacities on."""
RECORD_EVERY = 10
"""Steps between two entries of the history."""
LEAST_FIRST_SCALE = 1e-6
"""Minimum initial scale, m."""
ADAM_EPSILON = 1e-15
MOMENTS = ("exp_avg", "exp_avg_sq")
CHILDREN = 2
SHRINK = 1.6
"""Ratio of the sizes of a parent and of its children after a split."""


@dataclass(frozen=True)
class TrainedSplats:
    """Trained splats and the history of their training."""

    splats: Splats
    history: dict[str, list[float]]
    """Columns step, loss, splats."""
    first: int
    """Number of splats at the start."""


def first_splats(points: np.ndarray, colors: np.ndarray, settings: Appearance, width: float) -> Splats:
    """Initial splats at points [P, 3], m, with RGB [P, 3]; `width` is that of a pixel at the object, m.

    Raises InputError for fewer than four splats.
    """
    if settings.spacing and len(points):
        cells = np.floor((points - points.min(axis=0)) / (settings.spacing * width)).astype(np.int64)
        _, owner, members = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        owner = owner.reshape(-1)
        sums = [np.bincount(owner, weights=values) / members for values in (*points.T, *colors.T)]
        points, colors = np.stack(sums[:3], axis=1), np.stack(sums[3:], axis=1)
    if len(points) <= SCALE_NEIGHBORS:
        rule = f"more than {SCALE_NEIGHBORS} points are required"
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
    """Extent of the scene, m: 1.1 times the largest distance of a camera from the mean of all cameras.

    For a single camera it is the median depth of the object, or 1 m without depth.
    """
    if len(shots) == 1:
        measured = shots[0].depth[shots[0].depth > 0]
        return float(measured.median()) if len(measured) else 1.0
    centers = torch.stack([shot.view.position for shot in shots])
    return 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())


def train(start: Splats, shots: Sequence[Shot], settings: Appearance, seed: int, backend: Backend) -> TrainedSplats:
    """Fit splats to the shots. For a given seed the result is deterministic on the CPU.

    Raises NumericalFailure if splats become infinite or if all of them are removed.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = _Optimizer(Gaussians.of(start, str(shots[0].view.intrinsics.device)), settings, extent_of(shots))
    statistics = Statistics.empty(optimizer.gaussians.means)
    history: dict[str, list[float]] = {"step": [], "loss": [], "splats": []}
    progress = Progress("appearance", settings.iterations)
    # Splats added in the last step would stay untrained.
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
    """The settings with the learning rates of PhysTwin's released training."""

    position_rate: float = 1.6e-4
    """Initial learning rate of means, per extent of the scene (`extent_of`)."""
    color_rate: float = 2.5e-3
    """Learning rate of the first harmonic; the rate of the other harmonics is a twentieth of it."""
    scale_rate: float = 5e-3
    """Learning rate of log scales."""


class _Optimizer:
    """Adam over the tensors of `Gaussians`; the number of splats may change."""

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
        """The current splats."""
        values = dict(self._values)
        return Gaussians(harmonics=torch.cat([values.pop("base"), values.pop("bands")], dim=1), **values)

    def schedule(self, step: int) -> None:
        """Lower the learning rate of the means log-linearly."""
        done = min(step / POSITION_STEPS, 1.0)
        rate = math.exp((1 - done) * math.log(self.settings.position_rate) + done * math.log(POSITION_RATE_END))
        self._adam.param_groups[0]["lr"] = rate * self.extent

    def step(self) -> None:
        """Move all tensors against their gradients."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def require_usable(self, step: int) -> None:
        """Raise NumericalFailure if splats cannot be rendered."""
        if not len(self._values["means"]):
            raise NumericalFailure(f"appearance: step {step} removed the last splat")
        bad = [name for name, tensor in self._values.items() if not torch.isfinite(tensor.detach()).all()]
        # Infinite scales have finite logarithms.
        if bad or not torch.isfinite(torch.exp(self._values["log_scales"].detach())).all():
            raise NumericalFailure(f"appearance: after step {step} splats are not finite ({', '.join(bad) or 'scales'})")

    def replace(self, stay: torch.Tensor, added: dict[str, torch.Tensor]) -> None:
        """Keep the splats `stay` [N] bool with their moments; append `added` with zero moments."""
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
        """Limit all opacities: splats that no image needs stay faint and are removed later."""
        tensor = self._values["opacity_logits"]
        tensor.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in MOMENTS:
            self._adam.state[tensor][moment].zero_()


def _parameters(splats: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The tensors that Adam trains. The first harmonic learns faster than the others, so it is a separate parameter."""
    shades = splats["harmonics"]
    others = {name: tensor for name, tensor in splats.items() if name != "harmonics"}
    return others | {"base": shades[:, :1], "bands": shades[:, 1:]}


@dataclass
class Statistics:
    """Statistics of each splat over the rendered images since the number of splats last changed."""

    pull: torch.Tensor
    """Sum of the norms of the gradient of the image position, in half images [N]."""
    seen: torch.Tensor
    """Number of images that show the splat [N]."""
    radius: torch.Tensor
    """Largest radius, as a fraction of the image width [N]."""

    @classmethod
    def empty(cls, like: torch.Tensor) -> Statistics:
        """Statistics over no images, for splats with means `like` [N, 3]."""
        return cls(like.new_zeros(len(like)), like.new_zeros(len(like)), like.new_zeros(len(like)))

    @torch.no_grad()
    def add(self, rendered: Rendered, width: int, height: int) -> None:
        """Add an image after its backward pass."""
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
    """Clone, split and prune splats: returns which splats stay [N] bool, and the new splats with the keys of `splats`.

    The keys are those of `Gaussians`. `extent` is the size of the scene, m; with `after_reset` huge splats are removed too.
    """
    size = torch.exp(splats["log_scales"]).amax(1)
    mean_pull = statistics.pull / statistics.seen.clamp_min(1)
    coarse = mean_pull > DENSIFY_GRADIENT
    room = max(MOST_SPLATS - len(size), 0)
    # If the limit does not allow all, the splats with the largest gradients come first.
    if int(coarse.sum()) > room:
        coarse = torch.zeros_like(coarse).index_fill_(0, torch.topk(mean_pull, room).indices, True) & coarse
    # A split makes splats smaller, so splats with a fixed radius are cloned instead.
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
    """Which splats are faint or, after a reset, huge [N] bool."""
    faint = torch.sigmoid(splats["opacity_logits"]) < PRUNE_OPACITY
    if not after_reset or settings.fixed_radius:
        return faint
    return faint | (torch.exp(splats["log_scales"]).amax(1) > PRUNE_SIZE * extent)
