"""A double pendulum with viscous and dry friction in its joints, and a model without friction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import linear_map

from physx_core import Dataset, plugins
from physx_sim import JointSettings, Robot, Simulation, World

JOINTS, VISCOUS, DRY = ("shoulder", "elbow"), np.array([0.3, 0.15]), np.array([0.2, 0.1])
FIELDS = ("q", "v", "torque", "acceleration")
Function = Callable[..., torch.Tensor]


def pendulum(engine: str, *, friction: bool) -> Simulation:
    """Build the double pendulum."""
    joints = {
        name: JointSettings(damping=friction * viscous, friction=friction * dry)
        for name, viscous, dry in zip(JOINTS, VISCOUS, DRY, strict=True)
    }
    world = World([Robot("double_pendulum", joints=joints)])
    return plugins.resolve("backend", engine).build(world)


def as_torch(function: Callable[..., np.ndarray]) -> Function:
    """Wrap a function of arrays as a function of tensors, without gradients."""
    return lambda *given: torch.from_numpy(function(*(each.detach().numpy() for each in given)))


def measure(simulation: Simulation, samples: int, seed: int) -> list[torch.Tensor]:
    """Return random q, v and torques, and the accelerations that they cause, shape (n, 2) each."""
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.uniform(-np.pi, np.pi, (samples, 2)))
    v, torque = torch.from_numpy(rng.uniform(-4, 4, (2, samples, 2)))
    return [q, v, torque, as_torch(simulation.forward_dynamics_batch)(q, v, torque)]


def store(folder: Path, known: list[torch.Tensor], unseen: list[torch.Tensor]) -> Path:
    """Store what `measure` returned, and what a network sees of it; return the session's folder."""
    with Dataset.create(folder) as dataset:
        for mode, samples in (("training", known), ("validation", unseen)):
            q, v, torque, _ = samples
            seen = torch.hstack([q.sin(), q.cos(), v, torque])
            rows = {name: each.numpy() for name, each in zip(FIELDS, samples, strict=True)}
            dataset.append(mode, {**rows, "seen": seen.numpy()})
    return folder


def missing(model: Simulation, samples: list[torch.Tensor]) -> torch.Tensor:
    """Return the torques that a model lacks in samples, shape (n, 2), from its inverse dynamics."""
    q, v, torque, acceleration = (each.numpy() for each in samples)
    found = np.array(list(map(model.inverse_dynamics, q, v, acceleration)))
    return torch.from_numpy(torque - found)


def linear(given: list[torch.Tensor], wanted: torch.Tensor) -> Function:
    """Fit the linear map from several tensors to one."""
    fitted = as_torch(linear_map(torch.hstack(given).numpy(), wanted.numpy()))
    return lambda *values: fitted(torch.hstack(values))


def error(acceleration: Function, samples: list[torch.Tensor]) -> float:
    """Return the relative error of computed accelerations for samples."""
    *given, exact = samples
    guess = acceleration(*given).detach()
    return float(((guess - exact).norm(dim=1) / exact.norm(dim=1)).mean())
