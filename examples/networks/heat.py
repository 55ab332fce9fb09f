"""A graph network that learns how heat spreads along the edges of a mesh, without using physx."""

from __future__ import annotations

import torch
from torch_geometric.nn import MLP, EdgeConv, MessagePassing
from torch_geometric.utils import add_self_loops, softmax, to_undirected


class HeatNetwork(MessagePassing):
    """Repeatedly sets the temperature of each node to a weighted mean of its neighbors and itself.

    It learns the weights of these means, one per edge and repetition, from what both nodes know:
    their own conductivity, how far they are apart and, through an edge convolution, the same of
    their neighbors. The same layers process every edge of every mesh.
    """

    def __init__(self, channels: int, steps: int) -> None:
        super().__init__(aggr="add")
        options = {"act": "silu", "norm": None}
        self.look = EdgeConv(MLP([6, channels, channels], **options), aggr="mean")
        self.weigh = MLP([2 * channels + 5, channels, channels, steps], **options)
        self.last = torch.nn.Linear(1, 1)
        torch.nn.init.eye_(self.last.weight)

    def forward(
        self, place: torch.Tensor, edge: torch.Tensor, before: torch.Tensor
    ) -> torch.Tensor:
        """Map temperature, conductivity (nodes, 2) to temperature (nodes, 1).

        The nodes are those of several meshes, end to end; `edge` has the numbers of both nodes of
        each edge, shape (edges, 2).
        """
        temperature, conductivity = before.split(1, dim=-1)
        edges, _ = add_self_loops(to_undirected(edge.T), num_nodes=len(place))
        known = torch.cat([conductivity, place], dim=-1)
        seen = torch.cat([conductivity, self.look(known, edges)], dim=-1)
        there, here = (seen[ends] for ends in edges)
        way = place[edges[0]] - place[edges[1]]
        apart = torch.cat([way, way.norm(dim=1, keepdim=True)], dim=-1)
        weights = self.weigh(torch.cat([here, there - here, apart], dim=-1))
        weights = softmax(weights, edges[1], num_nodes=len(place))
        for weight in weights.split(1, dim=-1):
            temperature = self.propagate(edges, x=temperature, weight=weight)
        return self.last(temperature)

    def message(self, x_j: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        """Return a neighbor's contribution to a node's mean."""
        return weight * x_j
