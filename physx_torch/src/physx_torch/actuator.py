"""Learns what an actuator exerts beyond its command."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from physx_core.typing import Vector
from physx_sim import ActuatorNetwork

_FOLDS = 5
"""The last of as many parts of a log is held out, and the one before it ends the training."""


@dataclass(frozen=True, eq=False)
class LearnedActuator:
    """An actuator network, and how good it is on the last fifth of a log, which it has not seen.

    Attributes:
        network: The network.
        without: Root mean square of the targets there, in N m or N.
        left: Root mean square of what the network leaves of them.
    """

    network: ActuatorNetwork
    without: float
    left: float


def learn_actuator(
    torques: Vector,
    velocities: Vector,
    targets: Vector,
    period: float,
    *,
    samples: int = 5,
    width: int = 16,
    epochs: int = 200,
    seed: int = 0,
) -> LearnedActuator:
    """Learn torques from the history of torques and velocities of a joint.

    Args:
        torques: Commanded torques, shape (n,), in N m or N.
        velocities: Shape (n,), in rad/s or m/s.
        targets: What the actuator exerted beyond the command, shape (n,), in N m or N.
        period: Time between samples, in s.
        samples: Number of samples that the network sees.
        width: Width of its two hidden layers.
        epochs: Largest number of epochs; the best one on the fourth fifth of the log is taken.
        seed: Seed of weights and batches.

    Raises:
        ValueError: If there are not enough samples.
    """
    if len(targets) < 10 * _FOLDS * samples:
        raise ValueError(f"{len(targets)} samples are too few for an actuator network.")
    windows = np.lib.stride_tricks.sliding_window_view
    seen = np.concatenate(
        [windows(each, samples)[:, ::-1] for each in (torques, velocities)], axis=1
    )
    wanted, fifth = targets[samples - 1 :], len(targets) // _FOLDS
    learning = slice(0, len(wanted) - 2 * fifth)
    middle, spread = seen[learning].mean(axis=0), seen[learning].std(axis=0) + 1e-9
    size = float(wanted[learning].std()) + 1e-9
    x = torch.from_numpy((seen - middle) / spread).float()
    y = torch.from_numpy(wanted / size).float()[:, None]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        module = nn.Sequential(
            nn.Linear(2 * samples, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(),
            nn.Linear(width, 1),
        )  # fmt: skip
        best = _train(module, x, y, learning, slice(-2 * fifth, -fifth), epochs)
    module.load_state_dict(best)
    layers = [
        (layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy())
        for layer in module
        if isinstance(layer, nn.Linear)
    ]
    first, last = layers[0], layers[-1]  # the scales become part of them
    layers[0] = first[0] / spread, first[1] - first[0] @ (middle / spread)
    layers[-1] = last[0] * size, last[1] * size
    network = ActuatorNetwork(period, layers, float(np.abs(wanted[learning]).max()))
    held = slice(-fifth, None)
    left = wanted[held] - network(seen[held])
    rms = [float(np.sqrt(np.mean(each**2))) for each in (wanted[held], left)]
    return LearnedActuator(network, *rms)


def _train(
    module: nn.Module,
    x: torch.Tensor,
    y: torch.Tensor,
    learning: slice,
    judging: slice,
    epochs: int,
) -> dict[str, torch.Tensor]:
    """Return the weights that are best on the rows `judging` while those `learning` are learned."""
    optimizer = torch.optim.AdamW(module.parameters(), lr=5e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    best, least = {}, float("inf")
    count = len(x[learning])
    for epoch in range(epochs):
        for rows in torch.randperm(count).split(max(64, count // 8)):
            optimizer.zero_grad()
            loss = (module(x[learning][rows]) - y[learning][rows]).square().mean()
            loss.backward()
            optimizer.step()
        schedule.step()
        if epoch % 5 == 4:
            with torch.no_grad():
                error = float((module(x[judging]) - y[judging]).square().mean())
            if error < least:
                least = error
                best = {name: each.clone() for name, each in module.state_dict().items()}
    return best
