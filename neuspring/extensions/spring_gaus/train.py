"""Training of Spring-Gaus: each epoch replays the training frames from rest, with one optimizer step per frame.

- The gradient covers only one frame.
- An initial velocity v0 is added at the start of every frame and removed at its end, as in the public code. So an optimizer step
  changes the velocity in the middle of a trajectory.
- A frame that leaves the scene, or has a loss or gradient that is not finite, is simulated again with more substeps. At the
  maximum training ends as a failure, with the parameters of the last complete epoch.
- The result is the last epoch. The paper calls an epoch an iteration.

The loss compares the coverage of white splats on black with the object's mask in one camera:

    L = 0.2 |A - M| + 0.8 (1 - SSIM(A, M)) + |c(A) - c(M)| / W + 0.1 MSE(VGG16(A), VGG16(M)) + 2 TV(A)

A is the rendered coverage, M the mask, c the centroid in pixels, W the image width, TV the mean squared difference of neighbors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import Conv2d, MaxPool2d, ReLU, Sequential

from neuspring.baselines import Pictures, TrainingRequest
from neuspring.baselines.results import DIVERGENCE_RADIUS, Trained, TrainingStopped, run_epochs
from neuspring.config import Config
from neuspring.core.checkpoint import Checkpoint, adam_arrays, restore_adam
from neuspring.core.errors import InputError
from neuspring.data.capture import OBJECT, Capture
from neuspring.data.results import masks_of_cameras
from neuspring.extensions.spring_gaus.baseline import find_vgg16
from neuspring.extensions.spring_gaus.model import Follower, SpringGausModel, SpringGausTraining, choose_anchors
from neuspring.extensions.spring_gaus.physics import AnchorGraph, AnchorPhysics, AnchorSolver
from neuspring.scores.lpips import read_layers
from neuspring.splats.draw import view_of
from neuspring.splats.losses import ssim
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterize import choose_backend, rasterize
from neuspring.twin.losses import FrameLoss

Objective = Callable[[int, int, torch.Tensor], torch.Tensor | None]
"""(epoch, frame, anchors [N, 3], m, at the end of the frame) -> loss; None for a frame without data."""
Features = Callable[[torch.Tensor], torch.Tensor]
"""Images [B, 3, H, W] in 0..1 -> features."""
L1_WEIGHT, DSSIM_WEIGHT, FEATURE_WEIGHT, VARIATION_WEIGHT = 0.2, 0.8, 0.1, 2.0
"""Weights of the terms, as published."""
LEAST_COVER = 1e-6
"""Minimum area of a silhouette in its centroid, px."""
IMAGENET_MEANS, IMAGENET_DEVIATIONS = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Means and standard deviations of ImageNet's R, G, B in 0..1."""
SOFT_RATE = GROUND_RATE = 1e-3
"""Adam's learning rates of s, the parameter of the soft vector, and of rho."""
CLIP = 1.0
"""Maximum gradient norm of each tensor."""
SPRING_GAUS_ADAM_EPSILON = 1e-15
SUBSTEPS_ADDED, SUBSTEPS_RAISED = 50, (25, 50)
"""Substeps that are added at each of these iterations and after each failed frame."""
SPRING_GAUS_METRICS = ("loss", "gradient_norm", "substeps")


class UnusableFrame(ArithmeticError):
    """A frame that cannot be used for training, with the reason."""


@dataclass(frozen=True)
class Problem:
    """Initial model, data and loss of a training."""

    start: SpringGausModel
    hands: np.ndarray
    """Controllers in the training frames [T, C, 3], m."""
    objective: Objective
    settings: SpringGausTraining
    device: str = "cpu"


def train(request: TrainingRequest) -> Trained[SpringGausModel]:
    """Train on silhouettes or on points. Raises InputError for `supervision: masks` without images."""
    observations, settings, device = request.observations, request.settings, request.device
    chosen, scenario = SpringGausTraining(**vars(settings.baselines.spring_gaus)), observations.scenario
    pictures = request.pictures if chosen.supervision == "masks" else None
    if chosen.supervision == "masks" and pictures is None:
        rule = "supervision: masks requires --capture, --masks and --appearance"
        raise InputError("baselines.spring_gaus.supervision", rule, "none", "Use supervision: points for captures without images.")
    splats = Splats.load(pictures.splats) if pictures else None
    cloud = observations.nodes if splats is None else splats.means
    anchors = choose_anchors(cloud, chosen.anchors, np.random.default_rng(request.seed))
    hands = observations.controller_points[: scenario.train_end]
    graph = AnchorGraph.between(anchors, hands[0], chosen.neighbors)
    physics = AnchorPhysics(
        frame_time=1 / scenario.frame_rate,
        gravity=settings.simulation.gravity,
        up_sign=scenario.up_sign,
        ground=scenario.ground,
    )
    start = SpringGausModel.start(graph, physics, chosen)
    follower = Follower(cloud, start.anchors, start.bound_anchors, device)
    facts: dict[str, Any] = {"anchors": len(anchors), "links": len(graph.links)}
    if pictures and splats:
        weights = find_vgg16()
        facts |= {"vgg16": weights if isinstance(weights, str) else "computed", "splats": len(splats.means)}
        objective = silhouettes(pictures, splats, follower, weights, settings, request.seed, device)
    else:
        nodes, rest = (torch.tensor(points, device=device) for points in (observations.nodes, start.anchors))
        loss = FrameLoss.of(observations, settings.losses, device)

        def objective(epoch: int, frame: int, anchors: torch.Tensor) -> torch.Tensor:
            """Chamfer and track loss of structure points, which follow displacements: s_t = s_0 + sum w (a_t - a_0)."""
            return loss(frame, nodes + follower(anchors - rest))

    problem = Problem(start, hands, objective, chosen, device)
    result = run(problem, request.partial, request.key(vgg16=facts.get("vgg16") == "computed"))
    result.facts.update(facts)
    return result


def silhouettes(
    pictures: Pictures, splats: Splats, follower: Follower, weights: Path | str, settings: Config, seed: int, device: str
) -> Objective:
    """The loss of white splats on black against the object's mask, in one random camera per frame and epoch.

    Masks of future frames are not read.
    """
    capture, images = Capture.load(pictures.folder), settings.images
    masks = {
        (name, frame): torch.tensor(perceived.labels[frame], device=device) == OBJECT
        for name, perceived in masks_of_cameras(capture, pictures.masks).items()
        for frame in range(capture.train_end)
        if capture.shows(name, frame)
    }
    views = {name: view_of(camera, device) for name, camera in capture.cameras.items()}
    features = None if isinstance(weights, str) else load_features(weights, device)
    backend, shape = choose_backend(images.backend, device), Gaussians.of(splats, device)

    def objective(epoch: int, frame: int, anchors: torch.Tensor) -> torch.Tensor | None:
        cameras = [name for name in views if (name, frame) in masks]
        if not cameras:
            return None
        # The generator depends only on seed, epoch and frame, so that a resumed training draws the same cameras.
        name = cameras[int(np.random.default_rng([seed, epoch, frame]).integers(len(cameras)))]
        means = follower(anchors)
        white = torch.ones_like(means)
        drawn = rasterize(means, shape.quaternions, shape.scales, shape.opacities, white, views[name], backend=backend).alpha
        return silhouette_loss(drawn, masks[name, frame].float(), features)

    return objective


def run(problem: Problem, partial: Path | None = None, key: str = "") -> Trained[SpringGausModel]:
    """Train; resumes if `partial` contains a checkpoint with the same key."""
    return run_epochs(SpringGausTrainer(problem), SPRING_GAUS_METRICS, problem.settings.iterations, partial, key)


class SpringGausTrainer:
    """Runs epochs, one frame at a time."""

    def __init__(self, problem: Problem) -> None:
        self.problem, settings = problem, problem.settings
        model, device = problem.start, problem.device
        self.values = {name: tensor.requires_grad_() for name, tensor in model.tensors(device).items()}
        self.use_substeps(settings.substeps)
        rates = {
            "kappa": settings.stiffness_rate,
            "soft": SOFT_RATE,
            "theta": settings.damping_rate,
            "rho": GROUND_RATE,
            "velocity": settings.velocity_rate,
        }
        groups = [{"params": [tensor], "lr": rates[name]} for name, tensor in self.values.items()]
        self.optimizer = torch.optim.Adam(groups, eps=SPRING_GAUS_ADAM_EPSILON)
        self.rest = torch.tensor(model.anchors, device=device)
        self.hands = torch.tensor(problem.hands, device=device)
        self.keep()

    def use_substeps(self, count: int) -> None:
        """Set the number of substeps per frame."""
        model = self.problem.start
        self.substeps, self.solver = count, AnchorSolver(model, model, count, self.problem.device)

    def add_substeps(self) -> bool:
        """Increase the number of substeps per frame; False at the maximum."""
        more = min(self.substeps + SUBSTEPS_ADDED, self.problem.settings.max_substeps)
        if more == self.substeps:
            return False
        self.use_substeps(more)
        return True

    def epoch(self, number: int) -> dict[str, float]:
        """Run one pass over the frames. Raises TrainingStopped if a frame fails with the maximum number of substeps."""
        if number in SUBSTEPS_RAISED:
            self.add_substeps()
        x, v = self.rest, torch.zeros_like(self.rest)
        losses, largest = [], 0.0
        # The loop of the public code ends one frame before the last training frame.
        for frame in range(1, max(len(self.hands) - 1, 2)):
            after = None
            while after is None:
                try:
                    after = self.frame(number, frame, x, v)
                except UnusableFrame as fault:
                    if not self.add_substeps():
                        raise TrainingStopped(f"{fault} (iteration {number}, frame {frame}, {self.substeps} substeps)") from fault
                    print(f"iteration {number}, frame {frame}: {fault}; {self.substeps} substeps from now on", flush=True)
            x, v, loss, norm = after
            if loss is not None:
                losses.append(loss)
                largest = max(largest, norm)
        self.keep()
        return {"loss": float(np.mean(losses)) if losses else 0.0, "gradient_norm": largest, "substeps": float(self.substeps)}

    def frame(
        self, epoch: int, frame: int, x: torch.Tensor, v: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, float | None, float]:
        """Simulate a frame and make an optimizer step.

        Returns positions, velocities, loss, and the largest gradient norm of any tensor before clipping. Raises UnusableFrame.
        """
        parameters = self.problem.start.parameters(self.values)
        ends = self.hands[frame - 1], self.hands[frame]
        after, speed = self.solver.frame(parameters, x, v + self.values["velocity"], *ends)
        # NaN compares as false, so this condition catches NaN, infinity and absurd distances.
        if not bool((after.detach().abs() < DIVERGENCE_RADIUS).all() and torch.isfinite(speed.detach()).all()):
            raise UnusableFrame("the anchors left the scene")
        state = after.detach(), (speed - self.values["velocity"]).detach()
        if (loss := self.problem.objective(epoch, frame, after)) is None:
            return *state, None, 0.0
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        tensors = [tensor for tensor in self.values.values() if tensor.grad is not None]
        norms = torch.stack([tensor.grad.norm() for tensor in tensors if tensor.grad is not None])
        if not bool(torch.isfinite(loss.detach()) and torch.isfinite(norms).all()):
            raise UnusableFrame("the loss or its gradient is not finite")
        for tensor in tensors:
            torch.nn.utils.clip_grad_norm_([tensor], CLIP)
        self.optimizer.step()
        # If only the forces clamped the damping, a negative value would never get a gradient again.
        with torch.no_grad():
            self.values["theta"].clamp_(min=1.0)
        return *state, float(loss.detach()), float(norms.max())

    def keep(self) -> None:
        """Keep the current values as those of the last complete epoch."""
        self.complete = {name: tensor.detach().clone() for name, tensor in self.values.items()}

    def model(self) -> SpringGausModel:
        """The model with the values of the last complete epoch."""
        values: dict[str, Any] = {name: tensor.cpu().numpy() for name, tensor in self.complete.items()}
        return replace(self.problem.start, **values, substeps=self.substeps)

    def facts(self, epochs: int) -> dict[str, Any]:
        """Facts for the record."""
        return {"iterations": epochs, "substeps": self.substeps}

    def checkpoint(self) -> Checkpoint:
        """The state from which training resumes."""
        values = {name: tensor.detach().cpu().numpy() for name, tensor in self.values.items()}
        return Checkpoint({"values": values, "adam": adam_arrays(self.optimizer)}, {"substeps": self.substeps})

    @torch.no_grad()
    def restore(self, checkpoint: Checkpoint) -> None:
        """Set values, Adam's moments and the substeps."""
        self.use_substeps(checkpoint.values["substeps"])
        for name, tensor in self.values.items():
            tensor.copy_(torch.tensor(checkpoint.arrays["values"][name]))
        restore_adam(self.optimizer, checkpoint.arrays["adam"])
        self.keep()


def silhouette_loss(drawn: torch.Tensor, mask: torch.Tensor, features: Features | None) -> torch.Tensor:
    """Loss of a rendered coverage [H, W] against a mask [H, W], both in 0..1; without features their term is omitted."""
    total = L1_WEIGHT * (drawn - mask).abs().mean()
    total = total + DSSIM_WEIGHT * (1 - ssim(drawn[None], mask[None]))
    if bool(mask.any()):
        total = total + (centroid(drawn) - centroid(mask)).norm() / drawn.shape[1]
    if features is not None:
        rendered, target = (features(image.expand(1, 3, -1, -1)) for image in (drawn, mask))
        total = total + FEATURE_WEIGHT * (rendered - target.detach()).square().mean()
    return total + VARIATION_WEIGHT * total_variation(drawn)


def centroid(silhouette: torch.Tensor) -> torch.Tensor:
    """Mean (column, row) [2] of a silhouette [H, W], px."""
    rows = torch.arange(silhouette.shape[0], device=silhouette.device, dtype=silhouette.dtype)
    columns = torch.arange(silhouette.shape[1], device=silhouette.device, dtype=silhouette.dtype)
    total = silhouette.sum().clamp(min=LEAST_COVER)
    return torch.stack([(silhouette.sum(dim=0) * columns).sum(), (silhouette.sum(dim=1) * rows).sum()]) / total


def total_variation(picture: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of vertical neighbors of an image [H, W], plus that of horizontal neighbors."""
    return (picture[1:] - picture[:-1]).square().mean() + (picture[:, 1:] - picture[:, :-1]).square().mean()


def vgg16() -> Sequential:
    """The first convolutions of VGG16, in torchvision's order."""
    return Sequential(
        *(Conv2d(3, 64, 3, padding=1), ReLU(), Conv2d(64, 64, 3, padding=1), ReLU(), MaxPool2d(2)),
        *(Conv2d(64, 128, 3, padding=1), ReLU(), Conv2d(128, 128, 3, padding=1), ReLU()),
    )


def load_features(path: Path, device: str) -> Callable[[torch.Tensor], torch.Tensor]:
    """Images [B, 3, H, W] in 0..1 -> features [B, 128, H / 2, W / 2], differentiable. Raises InputError for a damaged file."""
    layers = read_layers(path, vgg16, device)

    def features(pictures: torch.Tensor) -> torch.Tensor:
        mean, deviation = (pictures.new_tensor(values)[:, None, None] for values in (IMAGENET_MEANS, IMAGENET_DEVIATIONS))
        result: torch.Tensor = layers((pictures - mean) / deviation)
        return result

    return features
