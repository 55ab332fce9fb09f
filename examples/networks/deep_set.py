"""A network for sets of points (Zaheer et al. 2017), which knows nothing of physx."""

import torch


class DeepSet(torch.nn.Module):
    """What it says of a cloud depends neither on the order of the points nor on their place.

    The same layers see each point, relative to the mean of all; the greatest value and the mean
    of what they find go through further layers.
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
        """Return what is guessed of clouds, shape (batch, points, 3), as (batch, outputs)."""
        found = self.each(points - points.mean(dim=1, keepdim=True))
        return self.all(torch.cat([found.amax(dim=1), found.mean(dim=1)], dim=1))
