"""Open-loop rollout of GS-Dynamics: structure points make a step whenever the tools have moved by one.

In a step, each particle b has the rotation R_b that best maps the offsets to its neighbors in the graph (Kabsch). Where these lie
on a line, it is the smallest rotation; where there are none, there is none. A point at x follows the particles b, which move by
u_b, with weights w_b ~ 1 / max(|x - b|, 0.1 mm):

    x' = x + sum_b w_b [(R_b - 1) (x - b) + u_b].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.baselines.gs_dynamics.model import HISTORY, Dynamics, Graph, GsDynamicsModel, connect, sample
from neuspring.baselines.gs_dynamics.windows import executed, upright
from neuspring.baselines.results import LIMIT, Prediction
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.device import load, start_warp
from neuspring.splats.skinning import turn_nodes

CLOSE = 1e-4
"""Distances are floored here before a weight is computed from them, m."""


@dataclass
class Steps:
    """The steps of a rollout: structure points in the frames in which the tools have moved by a step."""

    frames: list[int]
    positions: list[torch.Tensor]
    """[N, 3] m each."""
    particles: list[int] = field(default_factory=list)
    touched: list[int] = field(default_factory=list)
    """Edges between particles and tools."""
    reason: str = ""
    """Why the rollout ended early; empty: it did not."""
    diverged_frame: int | None = None


def predict(model: GsDynamicsModel, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Structure points in all frames, from those of frame 0 and the controllers; nothing else of the object is read.

    For a transfer, the observations are the target's and the model is the source's. The published transfers started from the
    source's points, registered to the target. The model has no splats of its own.
    """
    up = observations.scenario.up
    tools = upright(observations.controller_points, up)
    steps = roll_out(model, upright(observations.nodes, up), tools, device)
    end = len(tools) if steps.diverged_frame is None else steps.diverged_frame
    positions = upright(in_every_frame(steps.frames, torch.stack(steps.positions).cpu().numpy(), end), up)
    trajectory = Trajectory(positions=positions, frame_count=len(tools), diverged_frame=steps.diverged_frame, reason=steps.reason)
    facts = {
        "executed_steps": len(steps.frames) - 1,
        "tools": tools.shape[1],
        "particles": float(np.mean(steps.particles)) if steps.particles else 0.0,
        "tool_contacts": float(np.mean(steps.touched)) if steps.touched else 0.0,
    }
    return Prediction(trajectory, facts)


@torch.no_grad()
def roll_out(model: GsDynamicsModel, nodes: np.ndarray, tools: np.ndarray, device: str) -> Steps:
    """Roll out nodes [N, 3] m of frame 0 under tools [T, C, 3] m, with +z up."""
    dynamics = model.dynamics(device)
    start, hands = torch.tensor(nodes, device=device), torch.tensor(tools, device=device)
    steps = Steps([0], [start])
    history, last = start.expand(HISTORY, -1, -1), [0] * HISTORY
    for frame in executed(tools, model.rules.step):
        after = step(dynamics, history, hands[[*last, frame]], steps)
        # NaN compares false, so this catches it together with infinity and absurd distances.
        near = (after.abs() < LIMIT).all(dim=1)
        if not bool(near.all()):
            node = int((~near).nonzero()[0])
            steps.reason, steps.diverged_frame = f"node {node} left the scene in frame {frame}", frame
            break
        steps.frames.append(frame)
        steps.positions.append(after)
        history, last = torch.cat([history[1:], after[None]]), [*last[1:], frame]
    return steps


def step(dynamics: Dynamics, history: torch.Tensor, tools: torch.Tensor, steps: Steps) -> torch.Tensor:
    """Structure points [N, 3], m, after one step, from history [H, N, 3] and tools [H + 1, C, 3], m, of which the last is ahead."""
    rules, now = dynamics.rules, history[-1]
    first = torch.zeros(1, dtype=torch.long, device=now.device)
    usable = torch.ones(1, len(now), dtype=torch.bool, device=now.device)
    indices = sample(now[None], usable, rules.particles, rules.coverage, first)[0][0]
    particles = history[:, indices]
    used = torch.ones(1, len(indices), dtype=torch.bool, device=now.device)
    graph = connect(particles[-1:], used, tools[-2:-1], rules)
    moves = dynamics(graph, torch.cat([particles, tools[:-1]], dim=1), tools[-1] - tools[-2])
    steps.particles.append(len(indices))
    steps.touched.append(int((~graph.among_particles).sum()) // 2)
    if not bool(torch.isfinite(moves).all()):
        return torch.full_like(now, torch.nan)
    return carry(now, particles[-1], turns(graph, particles[-1], particles[-1] + moves), moves)


def in_every_frame(steps: list[int], positions: np.ndarray, frames: int) -> np.ndarray:
    """Positions [frames, N, 3], m, of which those [S, N, 3] in the frames `steps` are given.

    Between two steps points move on straight lines, which needs the next step and so works offline only; after the last they stay.
    """
    given_frames, frame = np.array(steps), np.arange(frames)
    before = np.searchsorted(given_frames, frame, side="right") - 1
    after = np.minimum(before + 1, len(given_frames) - 1)
    span = np.maximum(given_frames[after] - given_frames[before], 1)
    part = ((frame - given_frames[before]) / span).astype(positions.dtype)[:, None, None]
    # Exact where the two are the same.
    return np.asarray(positions[before] + part * (positions[after] - positions[before]))


def turns(graph: Graph, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """Rotations [P, 3, 3] of particles that moved from `before` to `after` [P, 3], m."""
    start_warp()
    count, among = graph.particles, graph.among_particles
    receivers, senders = (ends[among].cpu().numpy() for ends in (graph.receivers, graph.senders))
    order = np.argsort(receivers, kind="stable")
    receivers, senders = receivers[order], senders[order]
    slot = np.arange(len(receivers)) - np.searchsorted(receivers, receivers)
    # Neighbors [P, k] of each particle. Empty places hold the particle itself, which adds no offset.
    neighbors = np.repeat(np.arange(count, dtype=np.int32)[:, None], int(slot.max(initial=0)) + 1, axis=1)
    neighbors[receivers, slot] = senders
    # With a hundred particles the CPU is as fast as any device.
    positions: list[Any] = [
        wp.array(points.cpu().numpy().astype(np.float32), dtype=wp.vec3, device="cpu") for points in (before, after)
    ]
    table: Any = wp.array(neighbors, dtype=int, device="cpu")
    rotations, ranks = wp.zeros(count, dtype=wp.mat33, device="cpu"), wp.zeros(count, dtype=int, device="cpu")
    wp.launch(load(turn_nodes, "cpu"), count, [*positions, table, rotations, ranks], device="cpu")
    return torch.tensor(rotations.numpy(), dtype=before.dtype, device=before.device)


def carry(points: torch.Tensor, particles: torch.Tensor, rotations: torch.Tensor, displacements: torch.Tensor) -> torch.Tensor:
    """Points [N, 3] m after particles [P, 3] m with rotations [P, 3, 3] moved by displacements [P, 3], m."""
    weights = 1 / torch.cdist(points, particles, compute_mode="donot_use_mm_for_euclid_dist").clamp(min=CLOSE)
    weights = weights / weights.sum(dim=1, keepdim=True)
    bend = rotations - torch.eye(3, dtype=points.dtype, device=points.device)
    # sum_b w_b [B_b (x - b) + u_b] = (sum_b w_b B_b) x + sum_b w_b (u_b - B_b b), relative to a center to keep digits.
    center = particles.mean(dim=0)
    shift = displacements - torch.einsum("bij,bj->bi", bend, particles - center)
    turned = torch.einsum("nij,nj->ni", (weights @ bend.flatten(1)).view(-1, 3, 3), points - center)
    return points + turned + weights @ shift
