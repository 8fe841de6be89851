"""Open-loop rollout of a GS-Dynamics model: structure points make a step whenever the tools have moved by one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from neuspring.baselines.gs_dynamics.graph import connect, sample
from neuspring.baselines.gs_dynamics.model import GsDynamicsModel
from neuspring.baselines.gs_dynamics.network import Dynamics
from neuspring.baselines.gs_dynamics.propagate import carry, turns
from neuspring.baselines.gs_dynamics.tracks import tools_of, upright
from neuspring.baselines.gs_dynamics.windows import executed
from neuspring.baselines.results import LIMIT, Prediction
from neuspring.core.artifacts import Observations, Trajectory


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
    rotations = turns(graph, particles[-1], particles[-1] + moves)
    return carry(now, particles[-1], rotations, moves, rules)


@torch.no_grad()
def roll_out(model: GsDynamicsModel, nodes: np.ndarray, tools: np.ndarray, device: str) -> Steps:
    """Roll out nodes [N, 3] m of frame 0 under tools [T, C, 3] m, with +z up."""
    rules, dynamics = model.rules, model.dynamics(device)
    start, hands = torch.tensor(nodes, device=device), torch.tensor(tools, device=device)
    steps = Steps([0], [start])
    history, last = start.expand(rules.history, -1, -1), [0] * rules.history
    for frame in executed(tools, rules.step):
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


def in_every_frame(steps: list[int], positions: np.ndarray, frames: int, interpolate: bool) -> np.ndarray:
    """Positions [frames, N, 3], m, of which those [S, N, 3] in the frames `steps` are given.

    Between two steps points move on straight lines, or wait for the next; after the last they stay.
    """
    given_frames, frame = np.array(steps), np.arange(frames)
    before = np.searchsorted(given_frames, frame, side="right") - 1
    if not interpolate:
        return np.asarray(positions[before])
    after = np.minimum(before + 1, len(given_frames) - 1)
    span = np.maximum(given_frames[after] - given_frames[before], 1)
    part = ((frame - given_frames[before]) / span).astype(positions.dtype)[:, None, None]
    # Exact where the two are the same.
    return np.asarray(positions[before] + part * (positions[after] - positions[before]))


def predict(model: GsDynamicsModel, observations: Observations, device: str) -> Prediction:
    """Structure points in all frames, from those of frame 0 and the controllers; nothing else of the object is read.

    For a transfer, the observations are the target's and the model is the source's. The published transfers started from the
    source's points, registered to the target.
    """
    up = observations.scenario.up
    tools = tools_of(upright(observations.controller_points, up), model.rules)
    steps = roll_out(model, upright(observations.nodes, up), tools, device)
    end = len(tools) if steps.diverged_frame is None else steps.diverged_frame
    step_positions = torch.stack(steps.positions).cpu().numpy()
    positions = upright(in_every_frame(steps.frames, step_positions, end, model.rules.interpolate), up)
    trajectory = Trajectory(positions=positions, frame_count=len(tools), diverged_frame=steps.diverged_frame, reason=steps.reason)
    facts = {
        "executed_steps": len(steps.frames) - 1,
        "tools": tools.shape[1],
        "particles": float(np.mean(steps.particles)) if steps.particles else 0.0,
        "tool_contacts": float(np.mean(steps.touched)) if steps.touched else 0.0,
    }
    return Prediction(trajectory, facts)
