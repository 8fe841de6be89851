"""The graph network: what it sees, its layers, and its weights as one vector.

With receiver r and sender s of edge e, h the state of a node, c codes, R = ReLU:

    m_e = R(W_r [c_e, h_r, h_s]),    h' = R(W_p [c_n, sum_e m_e] + h),

a number of rounds with the same weights, from h = c_n. A head turns h of particles into displacements, m. Products with blocks of
W_r are taken of nodes and then gathered: the same sums, for fewer operations than products of what was gathered.
"""

from __future__ import annotations

import torch
from torch.nn.functional import linear, relu

from neuspring.baselines.gs_dynamics.graph import Graph
from neuspring.baselines.gs_dynamics.rules import Rules

UP_AXIS = 2
"""Positions here have +z up."""


def layers(rules: Rules) -> dict[str, tuple[int, int]]:
    """(outputs, inputs) of each linear layer, in the order in which weights are stored: matrix, then bias."""
    width = rules.width
    found: dict[str, tuple[int, int]] = {}
    for name, size in (("node", rules.node_size), ("edge", rules.edge_size)):
        found |= {f"{name}.{i}": (width, width if i else size) for i in range(3)}
    found |= {"relation": (width, 3 * width), "particle": (width, 2 * width)}
    return found | {f"head.{i}": (3 if i == 2 else width, width) for i in range(3)}


def weight_count(rules: Rules) -> int:
    """Length of the vector of weights."""
    return sum(outputs * (inputs + 1) for outputs, inputs in layers(rules).values())


def initial_weights(rules: Rules, seed: int) -> torch.Tensor:
    """Weights [W] as torch starts linear layers: uniform in +- 1 / sqrt(inputs)."""
    draw = torch.Generator().manual_seed(seed)
    parts = []
    for outputs, inputs in layers(rules).values():
        parts.append((torch.rand(outputs * (inputs + 1), generator=draw) * 2 - 1) / inputs**0.5)
    return torch.cat(parts)


class Dynamics:
    """A network with given weights [W]; gradients flow to them."""

    def __init__(self, rules: Rules, weights: torch.Tensor) -> None:
        self.rules, named = rules, layers(rules)
        sizes = [size for outputs, inputs in named.values() for size in (outputs * inputs, outputs)]
        parts = iter(weights.split(sizes))
        self._layers = {name: (next(parts).view(shape), next(parts)) for name, shape in named.items()}

    def __call__(self, graph: Graph, history: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Displacements [P, 3] of particles, m, in the next step.

        history [H, N, 3], m, oldest first: positions of the nodes. action [N - P, 3], m: the tools' next displacements.
        """
        nodes = self._encode("node", node_inputs(self.rules, graph, history, action))
        edges = self._encode("edge", edge_inputs(graph, history))
        (by_edge, by_receiver, by_sender), bias = self._blocks("relation", 3)
        (by_code, by_sum), particle_bias = self._blocks("particle", 2)
        of_edges, of_codes, state = linear(edges, by_edge, bias), linear(nodes, by_code, particle_bias), nodes
        for _ in range(self.rules.rounds):
            received = linear(state, by_receiver).index_select(0, graph.receivers)
            messages = relu(of_edges + received + linear(state, by_sender).index_select(0, graph.senders))
            total = torch.zeros_like(state).index_add(0, graph.receivers, messages)
            state = relu(of_codes + linear(total, by_sum) + state)
        hidden = state[: graph.particles]
        for name in ("head.0", "head.1"):
            hidden = relu(linear(hidden, *self._layers[name]))
        return linear(hidden, *self._layers["head.2"])

    def _encode(self, name: str, values: torch.Tensor) -> torch.Tensor:
        for i in range(3):
            values = relu(linear(values, *self._layers[f"{name}.{i}"]))
        return values

    def _blocks(self, name: str, count: int) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
        matrix, bias = self._layers[name]
        return matrix.chunk(count, dim=1), bias


def node_inputs(rules: Rules, graph: Graph, history: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """[N, 5 or 4 H + 2]: kind; unless short, heights and displacements in the history [H, N, 3]; action, 0 for particles."""
    nodes = history.shape[1]
    parts = [_kinds(torch.arange(nodes, device=history.device) < graph.particles, history)]
    if rules.node_input == "full":
        parts += [history[:, :, UP_AXIS].T, history.diff(dim=0).transpose(0, 1).reshape(nodes, -1)]
    return torch.cat([*parts, torch.cat([action.new_zeros(graph.particles, 3), action])], dim=1)


def edge_inputs(graph: Graph, history: torch.Tensor) -> torch.Tensor:
    """[E, 5 + 3 H]: kinds of receiver and sender, 1 between particle and tool, receiver - sender in each step of the history."""
    receives, sends = graph.receivers < graph.particles, graph.senders < graph.particles
    between = history.index_select(1, graph.receivers) - history.index_select(1, graph.senders)
    differs = (receives != sends).to(history.dtype)[:, None]
    offsets = between.transpose(0, 1).reshape(len(receives), -1)
    return torch.cat([_kinds(receives, history), _kinds(sends, history), differs, offsets], dim=1)


def _kinds(particle: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return torch.stack([particle, ~particle], dim=1).to(like.dtype)
