"""A graph network of torch-geometric on the plate's mesh: a plain PyTorch module."""

from __future__ import annotations

import torch
from environments import plate
from torch_geometric.nn import MLP, EdgeConv
from torch_geometric.utils import to_undirected


class GraphNetwork(torch.nn.Module):
    """Sends messages along the edges of the mesh, as often as it has layers.

    The edges are the same in every sample, so that torch-geometric's layers take the tensors of a
    batch, (samples, nodes, channels), as they are. Each node also knows its place.
    """

    def __init__(self, channels: int, layers: int) -> None:
        super().__init__()
        nodes, triangles = (torch.as_tensor(array) for array in plate())
        sides = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        self.register_buffer("edges", to_undirected(sides.T), persistent=False)
        self.register_buffer("places", nodes.float(), persistent=False)
        self.first = torch.nn.Linear(4, channels)
        self.layers = torch.nn.ModuleList(
            EdgeConv(MLP([2 * channels, channels, channels], act="silu", norm=None), aggr="add")
            for _ in range(layers)
        )
        self.last = torch.nn.Linear(channels, 1)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Return (samples, nodes, 1) from (samples, nodes, 2)."""
        places = self.places.expand(len(values), -1, -1)
        x = self.first(torch.cat([values, places], dim=-1))
        for layer in self.layers:
            x = x + layer(x, self.edges)
        return self.last(x)
