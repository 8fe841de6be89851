"""Training of splats on the views of frame 0: Adam, one view per step, harmonics unlocked by and by, adaptive density.

After section 3.1 of the released appearance; every number is a setting (`neuspring.config.images.Appearance`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from neuspring.config.images import Appearance
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.progress import Progress
from neuspring.splats import harmonics
from neuspring.splats.densify import Statistics, densify
from neuspring.splats.losses import Shot, loss
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterise import Backend

NEAREST = 3
"""The first scale of a splat is its mean distance to so many others."""
RESET_OPACITY = 0.01
RECORD_EVERY = 10
"""Steps between entries of the history."""
SMALLEST = 1e-6
"""m, of first scales."""
ADAM_EPSILON = 1e-15


@dataclass(frozen=True)
class Trained:
    """Splats and how they came to be."""

    splats: Splats
    history: dict[str, list[float]]
    """Columns step, loss, splats."""
    first: int
    """Splats at the start."""


def first_splats(points: np.ndarray, colours: np.ndarray, settings: Appearance, width: float) -> Splats:
    """Splats at points [P, 3], m, with RGB [P, 3]; `width`, m, is a pixel's at the object. Raises InputError for less than 4."""
    if settings.spacing and len(points):
        cells = np.floor((points - points.min(axis=0)) / (settings.spacing * width)).astype(np.int64)
        _, owner, members = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        owner = owner.reshape(-1)
        sums = [np.bincount(owner, weights=values) / members for values in (*points.T, *colours.T)]
        points, colours = np.stack(sums[:3], axis=1), np.stack(sums[3:], axis=1)
    if len(points) <= NEAREST:
        raise InputError("appearance, points of frame 0", f"more than {NEAREST} points are needed to begin with", len(points))
    near = np.maximum(cKDTree(points).query(points, k=NEAREST + 1)[0][:, 1:].mean(axis=1), SMALLEST)
    if settings.fixed_radius is not None:
        near = np.full(len(points), settings.fixed_radius)
    count, coefficients = len(points), (settings.degree + 1) ** 2
    shades = np.zeros((count, coefficients, 3))
    shades[:, 0] = (colours - 0.5) / harmonics.C0
    return Splats(
        means=points.astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.tile(np.log(near)[:, None], (1, 1 if settings.isotropic else 3)),
        opacity_logits=np.full(count, math.log(settings.opacity / (1 - settings.opacity))),
        harmonics=shades,
    )


def extent_of(shots: Sequence[Shot]) -> float:
    """1.1 times the largest distance of a camera from the mean camera, m; of a single camera, its distance to the object."""
    centres = torch.stack([shot.view.position for shot in shots])
    if len(shots) == 1:
        return float(shots[0].depth[shots[0].depth > 0].median()) if (shots[0].depth > 0).any() else 1.0
    return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())


def train(start: Splats, shots: Sequence[Shot], settings: Appearance, seed: int, backend: Backend) -> Trained:
    """Fit splats to the shots. Deterministic on the CPU for a seed.

    Raises NumericalFailure if splats become infinite or all of them are removed.
    """
    device = str(shots[0].view.intrinsics.device)
    generator = torch.Generator().manual_seed(seed)
    optimiser = _Optimiser(Gaussians.of(start, device), settings, extent_of(shots))
    statistics = Statistics.empty(optimiser.gaussians.means)
    history: dict[str, list[float]] = {"step": [], "loss": [], "splats": []}
    progress = Progress("appearance", settings.iterations)
    for step, shot in zip(range(1, settings.iterations + 1), _shuffled(shots, generator), strict=False):
        optimiser.schedule(step)
        drawn = optimiser.gaussians.draw(shot.view, degree=(step - 1) // settings.degree_every, backend=backend)
        value = loss(drawn, shot, settings)
        number = float(value.detach())
        value.backward()  # type: ignore[no-untyped-call]
        if step < settings.densify_until:
            statistics.add(drawn, shot.view.width, shot.view.height)
        optimiser.step()
        optimiser.require_usable(step)
        if step % RECORD_EVERY == 0 or step == settings.iterations:
            for name, entry in {"step": step, "loss": number, "splats": len(optimiser)}.items():
                history[name].append(float(entry))
        # New splats of the last step would not be trained.
        last = min(settings.densify_until, settings.iterations)
        if settings.densify_from < step < last and step % settings.densify_every == 0:
            kept, added = densify(
                vars(optimiser.gaussians),
                statistics,
                settings,
                optimiser.extent,
                step > settings.reset_every,
                generator,
            )
            optimiser.replace(kept, added)
            optimiser.require_usable(step)
            statistics = Statistics.empty(optimiser.gaussians.means)
        if step % settings.reset_every == 0 and step < last:
            optimiser.reset_opacities()
        progress.update(step, f"loss {number:.4f}, {len(optimiser)} splats")
    return Trained(optimiser.gaussians.stored(), history, len(start.means))


def _shuffled(shots: Sequence[Shot], generator: torch.Generator) -> Iterator[Shot]:
    while True:
        for index in torch.randperm(len(shots), generator=generator).tolist():
            yield shots[index]


class _Optimiser:
    """Adam over the tensors of `Gaussians`, whose number may change."""

    def __init__(self, gaussians: Gaussians, settings: Appearance, extent: float) -> None:
        self.settings, self.extent = settings, extent
        # The first harmonic learns faster than the others, so they are parameters of their own.
        values = dict(vars(gaussians))
        shades = values.pop("harmonics")
        values |= {"base": shades[:, :1], "bands": shades[:, 1:]}
        rates = {
            "means": settings.position_rate * extent,
            "quaternions": settings.rotation_rate,
            "log_scales": 0.0 if settings.fixed_radius else settings.scale_rate,
            "opacity_logits": settings.opacity_rate,
            "base": settings.colour_rate,
            "bands": settings.colour_rate / 20,
        }
        self._values = {name: tensor.clone().requires_grad_() for name, tensor in values.items()}
        groups = [{"params": [tensor], "lr": rates[name], "name": name} for name, tensor in self._values.items()]
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPSILON)

    def __len__(self) -> int:
        """Splats now."""
        return len(self._values["means"])

    @property
    def gaussians(self) -> Gaussians:
        """The splats as they are now."""
        v = self._values
        shades = torch.cat([v["base"], v["bands"]], dim=1)
        return Gaussians(v["means"], v["quaternions"], v["log_scales"], v["opacity_logits"], shades)

    def schedule(self, step: int) -> None:
        """Means learn more and more slowly, log-linearly."""
        done = min(step / self.settings.position_steps, 1.0)
        rate = math.exp((1 - done) * math.log(self.settings.position_rate) + done * math.log(self.settings.position_rate_end))
        self._adam.param_groups[0]["lr"] = rate * self.extent

    def step(self) -> None:
        """Move all tensors against their gradients."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def require_usable(self, step: int) -> None:
        """Raise NumericalFailure for splats that cannot be drawn."""
        if not len(self._values["means"]):
            raise NumericalFailure(f"appearance: step {step} removed the last splat")
        bad = [name for name, tensor in self._values.items() if not torch.isfinite(tensor.detach()).all()]
        # Infinite scales have finite logarithms.
        if bad or not torch.isfinite(torch.exp(self._values["log_scales"].detach())).all():
            raise NumericalFailure(f"appearance: after step {step} splats are not finite ({', '.join(bad) or 'scales'})")

    def replace(self, kept: torch.Tensor, added: dict[str, torch.Tensor]) -> None:
        """Keep some splats with their moments, append others without."""
        shades = added["harmonics"]
        new = added | {"base": shades[:, :1], "bands": shades[:, 1:]}
        for group in self._adam.param_groups:
            name, old = group["name"], group["params"][0]
            tensor = torch.cat([old.detach()[kept], new[name]]).requires_grad_()
            state = self._adam.state.pop(old, None)
            if state:
                moments = {key: torch.cat([state[key][kept], torch.zeros_like(new[name])]) for key in ("exp_avg", "exp_avg_sq")}
                self._adam.state[tensor] = state | moments
            group["params"][0] = self._values[name] = tensor

    @torch.no_grad()
    def reset_opacities(self) -> None:
        """Dim all splats, so that those that nothing needs stay dim and are removed."""
        tensor = self._values["opacity_logits"]
        tensor.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
        for moment in ("exp_avg", "exp_avg_sq"):
            self._adam.state[tensor][moment].zero_()


def restricted(splats: Splats, opacity: float) -> Splats:
    """Splats above an opacity. Raises NumericalFailure where none is."""
    kept = 1 / (1 + np.exp(-splats.opacity_logits)) > opacity
    if not kept.any():
        raise NumericalFailure(f"appearance: no splat has an opacity above {opacity}")
    return Splats(**{f.name: getattr(splats, f.name)[kept] for f in dataclasses.fields(Splats)})
