"""The graph network: what it sees, and its layers.

With receiver r and sender s of edge e, h the state of a node, c codes, R = ReLU:

    m_e = R(W_r [c_e, h_r, h_s]),    h' = R(W_p [c_n, sum_e m_e] + h),

a number of rounds with the same weights, from h = c_n. A head turns h of particles into displacements, m. Each block of W_r is
multiplied with nodes, and the products are gathered at edges: the same sums as products of gathered states, in fewer operations.
"""

from __future__ import annotations

from functools import partial

import torch
from torch.nn.functional import linear, relu
from torch.nn.utils import parameters_to_vector, skip_init, vector_to_parameters

from neuspring.baselines.gs_dynamics.graph import Graph
from neuspring.baselines.gs_dynamics.rules import Rules

UP_AXIS = 2
"""Positions here have +z up."""
# Without weights: they are drawn by `initial` or set by `of`.
Linear = partial(skip_init, torch.nn.Linear)


class Dynamics(torch.nn.Module):
    """The network. A model file holds its weights as one vector [W]: the parameters in their order, matrix before bias."""

    def __init__(self, rules: Rules) -> None:
        super().__init__()
        self.rules, width = rules, rules.width
        self.node, self.edge = _encoder(rules.node_size, width), _encoder(rules.edge_size, width)
        self.relation, self.particle = Linear(3 * width, width), Linear(2 * width, width)
        relu_layer = torch.nn.ReLU()
        self.head = torch.nn.Sequential(Linear(width, width), relu_layer, Linear(width, width), relu_layer, Linear(width, 3))

    @classmethod
    def of(cls, rules: Rules, weights: torch.Tensor) -> Dynamics:
        """The network with weights [W], on their device and of their dtype; it shares their memory."""
        network = cls(rules).to(weights)
        vector_to_parameters(weights, network.parameters())
        return network

    @classmethod
    def initial(cls, rules: Rules, seed: int, device: str = "cpu") -> Dynamics:
        """The network with weights as torch starts linear layers: uniform in +- 1 / sqrt(inputs)."""
        generator = torch.Generator().manual_seed(seed)
        layers = [layer for layer in cls(rules).modules() if isinstance(layer, torch.nn.Linear)]
        draws = [
            (torch.rand(layer.out_features * (layer.in_features + 1), generator=generator) * 2 - 1) / layer.in_features**0.5
            for layer in layers
        ]
        return cls.of(rules, torch.cat(draws).to(device))

    @property
    def weights(self) -> torch.Tensor:
        """A copy of the weights [W], without gradient."""
        return parameters_to_vector(self.parameters()).detach()

    def forward(self, graph: Graph, history: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Displacements [P, 3] of particles, m, in the next step.

        history [H, N, 3], m, oldest first: positions of the nodes. action [N - P, 3], m: the tools' next displacements.
        """
        nodes = self.node(node_inputs(self.rules, graph, history, action))
        edges = self.edge(edge_inputs(graph, history))
        by_edge, by_receiver, by_sender = self.relation.weight.chunk(3, dim=1)
        by_code, by_sum = self.particle.weight.chunk(2, dim=1)
        edge_part, code_part = linear(edges, by_edge, self.relation.bias), linear(nodes, by_code, self.particle.bias)
        state = nodes
        for _ in range(self.rules.rounds):
            received = linear(state, by_receiver).index_select(0, graph.receivers)
            messages = relu(edge_part + received + linear(state, by_sender).index_select(0, graph.senders))
            total = torch.zeros_like(state).index_add(0, graph.receivers, messages)
            state = relu(code_part + linear(total, by_sum) + state)
        displacements: torch.Tensor = self.head(state[: graph.particles])
        return displacements


def _encoder(inputs: int, width: int) -> torch.nn.Sequential:
    relu_layer = torch.nn.ReLU()
    layers = (Linear(inputs, width), Linear(width, width), Linear(width, width))
    return torch.nn.Sequential(*(module for layer in layers for module in (layer, relu_layer)))


def weight_count(rules: Rules) -> int:
    """Length of the vector of weights."""
    return sum(parameter.numel() for parameter in Dynamics(rules).parameters())


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
