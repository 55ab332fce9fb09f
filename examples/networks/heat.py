"""A graph network that learns how heat spreads along the edges of a mesh, without using physx."""

from __future__ import annotations

import torch
from environments.plate import mesh
from torch_geometric.nn import MLP, EdgeConv, MessagePassing
from torch_geometric.utils import add_self_loops, softmax, to_undirected


class HeatNetwork(MessagePassing):
    """Repeatedly sets the temperature of each node to a weighted mean of its neighbors and itself.

    It learns the weights of these means, one per edge and repetition, from what both nodes know:
    their own conductivity and position and, through an edge convolution, those of their neighbors.
    The same layers process every edge.
    """

    def __init__(self, channels: int, steps: int) -> None:
        super().__init__(aggr="add", node_dim=1)  # axes: samples, nodes, channels
        nodes, triangles = (torch.as_tensor(array) for array in mesh())
        sides = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).long()
        length = (nodes[sides[:, 0]] - nodes[sides[:, 1]]).norm(dim=1).mean()
        places = (nodes - nodes.mean(dim=0)) / length
        edges, _ = add_self_loops(to_undirected(sides.T))
        self.register_buffer("places", places.float(), persistent=False)
        self.register_buffer("edges", edges, persistent=False)
        options = {"act": "silu", "norm": None}
        self.look = EdgeConv(MLP([6, channels, channels], **options), aggr="add")
        self.weigh = MLP([2 * channels + 6, channels, channels, steps], **options)
        self.last = torch.nn.Linear(1, 1)
        torch.nn.init.eye_(self.last.weight)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Map temperature, conductivity (samples, nodes, 2) to temperature (samples, nodes, 1)."""
        temperature, conductivity = values.split(1, dim=-1)
        known = torch.cat([conductivity, self.places.expand(len(values), -1, -1)], dim=-1)
        known = torch.cat([known, self.look(known, self.edges)], dim=-1)
        there, here = (known[:, ends] for ends in self.edges)
        weights = self.weigh(torch.cat([here, there - here], dim=-1))
        weights = softmax(weights, self.edges[1], num_nodes=len(self.places), dim=1)
        for weight in weights.split(1, dim=-1):
            temperature = self.propagate(self.edges, x=temperature, weight=weight)
        return self.last(temperature)

    def message(self, x_j: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """Return a neighbor's contribution to a node's mean."""
        return weight * x_j
