"""A picture of the learned friction, and of how the pendulum swings with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from environments.double_pendulum import DRY, JOINTS, VISCOUS, Function, as_torch
from matplotlib.figure import Figure

from physx_sim import Simulation

PERIOD, STEPS = 5e-3, 1000
NAME = "network in the model"
STYLES = ({"color": "black", "lw": 4, "alpha": 0.3}, {"color": "tab:orange"}, {"color": "tab:blue"})


def friction(v: torch.Tensor) -> torch.Tensor:
    """Return the true friction torques at speeds, shape (n, 2) each."""
    return torch.from_numpy(VISCOUS) * v + torch.from_numpy(DRY) * v.sign()


def swing(acceleration: Function) -> np.ndarray:
    """Release the pendulum and return its angles after each period, shape (STEPS, 2)."""
    q, v = torch.tensor([[1.2, 0.4]]).double(), torch.zeros(1, 2).double()
    angles = []
    for _ in range(STEPS):
        v = v + PERIOD * acceleration(q, v, torch.zeros_like(v)).detach()
        q = q + PERIOD * v
        angles.append(q.numpy()[0])
    return np.array(angles)


def plot(axis: Any, x: Any, curves: dict[str, Any]) -> None:
    """Plot curves over x, with a legend."""
    for (name, y), style in zip(curves.items(), STYLES, strict=True):
        axis.plot(x, y, label=name, **style)
    axis.legend(fontsize=8)


def draw(
    path: Path, real: Simulation, model: Function, law: Function, network: Function, way: Function
) -> None:
    """Draw friction laws over speed, and how the elbow swings after its release.

    `network` predicts what the model lacks, and `way` the accelerations that follow.
    """
    figure = Figure((11, 3.4), layout="constrained")
    axes: Any = figure.subplots(1, 3)
    v = torch.linspace(-4, 4, 401).double()[:, None].expand(-1, 2)
    laws = {"truth": friction(v), "linear law": law(v), NAME: network(v).detach()}
    for joint, title in enumerate(JOINTS):
        plot(axes[joint], v[:, joint], {name: torque[:, joint] for name, torque in laws.items()})
        axes[joint].set(title=f"friction of the {title}", xlabel="speed [rad/s]", ylabel="[N m]")
    truth = as_torch(real.forward_dynamics_batch)
    ways = {"truth": truth, "model without friction": model, NAME: way}
    swings = {name: swing(way)[:, 1] for name, way in ways.items()}
    plot(axes[2], PERIOD * np.arange(STEPS), swings)
    axes[2].set(
        title="the elbow, let go", xlabel="time [s]", ylabel="angle [rad]", ylim=(-1.6, 2.4)
    )
    figure.savefig(path, dpi=90)
