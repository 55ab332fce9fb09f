"""A plain module that reads padded samples and their masks."""

import torch


class Pooled(torch.nn.Module):
    """Predicts a value of each node from its own, the load, all nodes, and its neighbors."""

    def __init__(self, hidden=8):
        super().__init__()
        self.encode = torch.nn.Linear(2, hidden)
        self.decode = torch.nn.Linear(3 * hidden, 1)

    def forward(self, x, edge, load, nodes, edges):
        """Return u, shape (samples, nodes), of padded samples."""
        both = torch.stack([x[..., 0], load[:, None].expand_as(x[..., 0])], -1)
        hidden = torch.tanh(self.encode(both)) * nodes[..., None]
        mean = hidden.sum(1, keepdim=True) / nodes.sum(1)[:, None, None].clamp(min=1)
        sent = torch.zeros_like(hidden)
        of = torch.arange(len(x))[:, None].expand_as(edge[..., 0])
        first = hidden[of, edge[..., 0]] * edges[..., None]
        sent = sent.index_put((of, edge[..., 1]), first, accumulate=True)
        return self.decode(torch.cat([hidden, mean.expand_as(hidden), sent], -1))[..., 0]
