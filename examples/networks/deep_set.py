"""A network for sets of points (Zaheer et al. 2017) that knows nothing about physx."""

import torch


class DeepSet(torch.nn.Module):
    """A network whose output depends neither on the order of the points nor on their position.

    The same layers process each point, relative to the mean of all points; the maximum and the mean
    of their outputs go through further layers.
    """

    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.each, self.all = self.layers(3, width, width), self.layers(2 * width, width, outputs)

    @staticmethod
    def layers(first: int, width: int, last: int) -> torch.nn.Sequential:
        return torch.nn.Sequential(
            torch.nn.Linear(first, width), torch.nn.ReLU(), torch.nn.Linear(width, last)
        )

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """Return the outputs, shape (batch, outputs), for clouds of shape (batch, points, 3)."""
        found = self.each(points - points.mean(dim=1, keepdim=True))
        return self.all(torch.cat([found.amax(dim=1), found.mean(dim=1)], dim=1))
