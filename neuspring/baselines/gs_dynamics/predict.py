"""Open-loop rollout of a GS-Dynamics model: structure points move a step whenever the tools have moved one."""

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
    """The steps of a rollout: where structure points are when the tools have moved a step."""

    frames: list[int]
    positions: list[torch.Tensor]
    """[N, 3] m each."""
    particles: list[int] = field(default_factory=list)
    touched: list[int] = field(default_factory=list)
    """Edges between particles and tools."""
    reason: str = ""
    """Why the rollout ended early, ..."""
    diverged_frame: int | None = None
    """... and where."""


def step(dynamics: Dynamics, history: torch.Tensor, tools: torch.Tensor, steps: Steps) -> torch.Tensor:
    """Structure points [N, 3], m, after one step; history [H, N, 3], m, and tools [H + 1, C, 3], m, the last of which is next."""
    rules, now = dynamics.rules, history[-1]
    first = torch.zeros(1, dtype=torch.long, device=now.device)
    usable = torch.ones(1, len(now), dtype=torch.bool, device=now.device)
    chosen = sample(now[None], usable, rules.particles, rules.coverage, first)[0][0]
    particles = history[:, chosen]
    used = torch.ones(1, len(chosen), dtype=torch.bool, device=now.device)
    graph = connect(particles[-1:], used, tools[-2:-1], rules)
    moves = dynamics(graph, torch.cat([particles, tools[:-1]], dim=1), tools[-1] - tools[-2])
    steps.particles.append(len(chosen))
    steps.touched.append(int((~graph.among_particles).sum()) // 2)
    if not bool(torch.isfinite(moves).all()):
        return torch.full_like(now, torch.nan)
    rotations = turns(graph, particles[-1], particles[-1] + moves)
    return carry(now, particles[-1], rotations, moves, rules)


@torch.no_grad()
def roll_out(model: GsDynamicsModel, nodes: np.ndarray, tools: np.ndarray, device: str) -> Steps:
    """Nodes [N, 3] m of frame 0 under tools [T, C, 3] m, +z up, without any other look at the object."""
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
    """[frames, N, 3] m of positions [S, N, 3] in frames `steps`: on straight lines between them, or held; held after the last."""
    known, frame = np.array(steps), np.arange(frames)
    before = np.searchsorted(known, frame, side="right") - 1
    if not interpolate:
        return np.asarray(positions[before])
    after = np.minimum(before + 1, len(known) - 1)
    span = np.maximum(known[after] - known[before], 1)
    part = ((frame - known[before]) / span).astype(positions.dtype)[:, None, None]
    # Exact where the two are the same.
    return np.asarray(positions[before] + part * (positions[after] - positions[before]))


def predict(model: GsDynamicsModel, observations: Observations, device: str) -> Prediction:
    """Structure points over all frames, from those of frame 0 and the controllers; the object is not looked at later.

    For a transfer, observations are the target's: its structure points and controllers, with the weights of the source. The
    published transfers started from the source's points, registered to the target.
    """
    up = observations.scenario.up
    tools = tools_of(upright(observations.controller_points, up), model.rules)
    steps = roll_out(model, upright(observations.nodes, up), tools, device)
    asked = len(tools)
    kept = asked if steps.diverged_frame is None else steps.diverged_frame
    places = torch.stack(steps.positions).cpu().numpy()
    positions = upright(in_every_frame(steps.frames, places, kept, model.rules.interpolate), up)
    trajectory = Trajectory(positions=positions, frame_count=asked, diverged_frame=steps.diverged_frame, reason=steps.reason)
    facts = {
        "executed_steps": len(steps.frames) - 1,
        "tools": tools.shape[1],
        "particles": float(np.mean(steps.particles)) if steps.particles else 0.0,
        "tool_contacts": float(np.mean(steps.touched)) if steps.touched else 0.0,
    }
    return Prediction(trajectory, facts)
