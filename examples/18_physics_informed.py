"""Equations of motion inside the loss.

A double pendulum has friction in its joints; its model has none. From 500 samples (q, v, torque) ->
acceleration, a network learns the torques that the model lacks, although nobody measured them:
gradients flow through the equations of motion. Its rivals are networks without the model, one that
corrects the model's accelerations, a linear map, and a linear friction law.

    python examples/18_physics_informed.py             # a minute
    python examples/18_physics_informed.py --small     # a few seconds, to see that it works
"""

from __future__ import annotations

from functools import partial

import torch
from common import SEEDS, conclude, options
from environments.double_pendulum import error, linear, measure, missing, pendulum
from environments.double_pendulum_picture import draw

from physx_core import Comparison
from physx_torch import ForwardDynamics


def alone(network, model, q, v, torque):
    return network(torch.cat([q.sin(), q.cos(), v, torque], dim=1))


def correction(network, model, q, v, torque):
    return model(q, v, torque) + alone(network, model, q, v, torque)


def inside(network, model, q, v, torque):
    return model(q, v, torque - network(v))


NETWORK = "network in the model"
KINDS = {
    "network of width 64": (alone, 8, 64),
    "network of width 128": (alone, 8, 128),
    "model + network": (correction, 8, 128),
    NETWORK: (inside, 2, 64),
}


def train(way, inputs, width, model, known, epochs, seed):
    """Fit a network to all samples at once; return a function that computes accelerations."""
    torch.manual_seed(seed)
    first, second, third = map(torch.nn.Linear, (inputs, width, width), (width, width, 2))
    network = torch.nn.Sequential(first, torch.nn.Tanh(), second, torch.nn.Tanh(), third).double()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    for _ in range(epochs):
        optimizer.zero_grad()
        torch.nn.functional.smooth_l1_loss(way(network, model, *known[:3]), known[3]).backward()
        optimizer.step()
        scheduler.step()
    return partial(way, network, model)


def main() -> int:
    """Compare; the exit status tells whether the network in the model beats its rivals."""
    chosen = options(__doc__).parse_args()
    rows, epochs, seeds = (200, 150, SEEDS[:1]) if chosen.small else (500, 1000, SEEDS)
    with pendulum("dart", friction=True) as real, pendulum("pinocchio", friction=False) as simple:
        known, unseen = measure(real, rows, seed=0), measure(real, 1000, seed=1)
        model, law = ForwardDynamics(simple), linear([known[1]], missing(simple, known))
        ways = {"linear map": [linear(known[:3], known[3])], "model without friction": [model]}
        ways["model + linear friction"] = [partial(inside, law, model)]
        for name, kind in KINDS.items():
            ways[name] = [train(*kind, model, known, epochs, seed) for seed in seeds]
        errors = {name: [error(way, unseen) for way in found] for name, found in ways.items()}
        if chosen.picture:
            draw(chosen.picture, real, model, law, NETWORK, ways[NETWORK][0])
    return conclude(Comparison(errors, NETWORK, networks=list(KINDS)), small=chosen.small)


if __name__ == "__main__":
    raise SystemExit(main())
