"""The training problem of Spring-Gaus: anchors drawn from splats or structure points, and the objective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuspring.baselines.spring_gaus import vgg16_weights
from neuspring.baselines.spring_gaus.graph import AnchorGraph, Binding, choose_anchors
from neuspring.baselines.spring_gaus.model import SpringGausModel
from neuspring.baselines.spring_gaus.objectives import Follower, Masks, Points, Silhouettes
from neuspring.baselines.spring_gaus.silhouettes import SilhouetteLoss
from neuspring.baselines.spring_gaus.train import Objective, Problem
from neuspring.baselines.spring_gaus.vgg16 import Vgg16
from neuspring.config import Config
from neuspring.config.spring_gaus import SpringGaus
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.perception.results import masks_of_cameras
from neuspring.splats.draw import view_of
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.rasterize import Backend, choose_backend
from neuspring.splats.view import View
from neuspring.twin.losses import FrameLoss

CELLS = (0.01, 0.001)
"""Cell sizes of the grids that anchors are drawn from, m."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Masks of the training frames, and the splats that should cover them."""

    splats: Splats
    views: dict[str, View]
    masks: Masks
    backend: Backend

    @classmethod
    def of(cls, folder: Path, records: Sequence[Path], splats: Path, settings: Config, device: str) -> Seen:
        """From a capture, the records of its masks and a file of splats. Masks of future frames are not used."""
        capture, images = Capture.load(folder), settings.images
        cameras = masks_of_cameras(capture, records)
        masks: Masks = {}
        for name, perceived in cameras.items():
            for frame in (frame for frame in range(capture.train_end) if capture.has(name, frame)):
                labels = torch.tensor(perceived.labels[frame], device=device)
                counts = labels != HANDS if settings.baselines.spring_gaus.ignore_hands else None
                masks[name, frame] = labels == OBJECT, counts
        views = {name: view_of(camera, images, device) for name, camera in capture.cameras.items()}
        return cls(Splats.load(splats), views, masks, choose_backend(images.backend, device))


def problem(
    observations: Observations, seen: Seen | None, settings: Config, seed: int, device: str
) -> tuple[Problem, dict[str, Any]]:
    """The training problem, and facts for the record. Raises InputError for `supervision: masks` without `seen`."""
    own, scenario = settings.baselines.spring_gaus, observations.scenario
    if own.supervision == "masks" and seen is None:
        rule = "supervision: masks needs --capture, --masks and --appearance"
        raise InputError("baselines.spring_gaus.supervision", rule, "none", "Use supervision: points for captures without images.")
    cloud = seen.splats.means if seen and own.supervision == "masks" else observations.nodes
    anchors = choose_anchors(cloud, own.anchors, CELLS, np.random.default_rng(seed))
    hands = observations.controller_points[: scenario.train_end]
    graph = AnchorGraph.between(anchors, hands[0], own.neighbors, own.link_reach, own.link_count)
    up = 1.0 if scenario.up == "+z" else -1.0
    world = {"frame_time": 1 / scenario.frame_rate, "up_sign": up, "gravity": settings.simulation.gravity}
    start = SpringGausModel.start(graph, own, ground=scenario.ground, **world)
    facts: dict[str, Any] = {"anchors": len(anchors), "links": len(graph.links)}
    objective: Objective
    if seen and own.supervision == "masks":
        objective, more = _silhouettes(seen, start, own, seed, device)
        facts |= more
    else:
        objective = _points(observations, start, settings, device)
    return Problem(start, hands, objective, own, device), facts


def _silhouettes(
    seen: Seen, start: SpringGausModel, settings: SpringGaus, seed: int, device: str
) -> tuple[Silhouettes, dict[str, Any]]:
    weights = vgg16_weights.find(settings.vgg16) if settings.features else "not asked for"
    features = None if isinstance(weights, str) else Vgg16.load(weights, device)
    follower = Follower(Binding.of(seen.splats.means, start.anchors, start.bound_anchors), device)
    loss = SilhouetteLoss(settings, features)
    objective = Silhouettes(Gaussians.of(seen.splats, device), follower, seen.views, seen.masks, loss, seen.backend, seed)
    return objective, {"vgg16": weights if isinstance(weights, str) else "computed", "splats": len(seen.splats.means)}


def _points(observations: Observations, start: SpringGausModel, settings: Config, device: str) -> Points:
    nodes = torch.tensor(observations.nodes, device=device)
    follower = Follower(Binding.of(observations.nodes, start.anchors, start.bound_anchors), device)
    return Points(nodes, torch.tensor(start.anchors, device=device), follower, FrameLoss.of(observations, settings.losses, device))
