"""Learn what a model does not know, with the equations of motion inside the loss.

A double pendulum in DART has viscous and dry friction in its joints. The model of it in Pinocchio
has none. From few samples (q, v, torque) -> acceleration, one network learns the accelerations;
another one learns the friction torques, and its loss is of the accelerations that the model has
under them: gradients go through the equations of motion.

    python examples/physics_informed/run.py             # about 10 s of one core
    python examples/physics_informed/run.py --small     # some seconds, to see that it works
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import torch

from physx_core import JointSettings, Robot, Simulation, World, plugins
from physx_torch import ForwardDynamics

VISCOUS, DRY = (0.3, 0.15), (0.2, 0.1)
JOINTS = ("shoulder", "elbow")


@dataclass(frozen=True)
class Size:
    """How much is done."""

    samples: int
    epochs: int
    least_gain: float


FULL, SMALL = Size(500, 1000, least_gain=10.0), Size(200, 150, least_gain=2.0)


def pendulum(engine: str, viscous: tuple, dry: tuple) -> Simulation:
    """Build the double pendulum with friction in its joints."""
    joints = {
        name: JointSettings(damping=c, friction=f)
        for name, c, f in zip(JOINTS, viscous, dry, strict=True)
    }
    world = World([Robot("double_pendulum", joints=joints)])
    return plugins.resolve("backend", engine).build(world)


def measure(simulation: Simulation, samples: int, seed: int) -> list[torch.Tensor]:
    """Return random states and torques, and the accelerations that they cause."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (samples, 2))
    v, torque = rng.uniform(-4, 4, (2, samples, 2))
    acceleration = simulation.forward_dynamics_batch(q, v, torque)
    return [torch.from_numpy(values) for values in (q, v, torque, acceleration)]


def perceptron(inputs: int, outputs: int) -> torch.nn.Module:
    """Return a small network."""
    layers = [torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64)]
    return torch.nn.Sequential(*layers, torch.nn.Tanh(), torch.nn.Linear(64, outputs)).double()


class BlackBox(torch.nn.Module):
    """Accelerations by a network alone."""

    def __init__(self) -> None:
        super().__init__()
        self.network = perceptron(8, 2)

    def forward(self, q, v, torque):
        return self.network(torch.cat([q.sin(), q.cos(), v, torque], dim=1))


class Informed(torch.nn.Module):
    """Accelerations by the equations of motion, under friction torques by a network."""

    def __init__(self, dynamics: ForwardDynamics) -> None:
        super().__init__()
        self.dynamics, self.friction = dynamics, perceptron(2, 2)

    def forward(self, q, v, torque):
        return self.dynamics(q, v, torque - self.friction(v))


def train(model: torch.nn.Module, data: list[torch.Tensor], epochs: int) -> None:
    """Fit a model to all samples at once."""
    *inputs, acceleration = data
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    for _ in range(epochs):
        optimizer.zero_grad()
        loss = torch.nn.functional.smooth_l1_loss(model(*inputs), acceleration)
        loss.backward()
        optimizer.step()
        scheduler.step()


def error(model: torch.nn.Module, data: list[torch.Tensor]) -> float:
    """Return the mean error of the accelerations, relative to their mean size."""
    *inputs, acceleration = data
    with torch.no_grad():
        return float((model(*inputs) - acceleration).abs().mean() / acceleration.abs().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="see that it works")
    size = SMALL if parser.parse_args().small else FULL
    torch.manual_seed(0)
    torch.set_num_threads(1)
    nothing = (0.0, 0.0)
    with pendulum("dart", VISCOUS, DRY) as real, pendulum("pinocchio", nothing, nothing) as model:
        known, unseen = measure(real, size.samples, seed=0), measure(real, 1000, seed=1)
        dynamics = ForwardDynamics(model)
        candidates = {"network alone": BlackBox(), "equations of motion": Informed(dynamics)}
        print(f"error of accelerations in 1000 unseen states, from {size.samples} samples")
        print(f"  {'model without friction':22} {error(dynamics, unseen):8.2%}")
        errors = {}
        for name, candidate in candidates.items():
            train(candidate, known, size.epochs)
            errors[name] = error(candidate, unseen)
            print(f"  {name:22} {errors[name]:8.2%}")
    speeds = torch.tensor([[2.0, 2.0]], dtype=torch.float64)
    learned = candidates["equations of motion"].friction(speeds)[0].tolist()
    for name, found, c, f in zip(JOINTS, learned, VISCOUS, DRY, strict=True):
        print(f"friction of the {name} at 2 rad/s: {found:.3f} N m, in truth {2 * c + f:.3f} N m")
    gain = errors["network alone"] / errors["equations of motion"]
    print(f"the equations of motion make the error {gain:.1f} times smaller")
    if gain < size.least_gain:
        raise SystemExit(f"expected at least {size.least_gain} times")


if __name__ == "__main__":
    main()
