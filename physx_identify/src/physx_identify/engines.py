"""Refits on other engines: which values depend on the engine whose steps the fit takes.

The fit's torques are those of Pinocchio's dynamics in steps of the log's period; an engine solves
friction, damping and limits of a step in its own way. It gets the identified robot and each state
of the fit's path, and the torques are found that bring it to the next one. They take the place of
the fit's own, and the values are fitted anew, with the same path, instruments and noise: nothing
but the engine's steps makes the difference.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_core.typing import Array, Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.fit import Fit
from physx_identify.estimation.model import Model, Path
from physx_identify.result.estimates import EngineFit
from physx_identify.result.identification import UNSETTABLE, Identification
from physx_identify.unknowns import Parameter
from physx_sim import Backend, JointSettings, Robot, Simulation, World

_STEPS, _CLOSE = 8, 0.02
"""Most steps of a refit; and how small its last one is, in standard errors."""
_CORRECTIONS = 20
_MISSING = 1e-3
"""Torque missing to a state, relative to those of its joint, from which it is not reached."""


def find_engines(
    names: Sequence[str], world: World, parameters: Sequence[Parameter]
) -> dict[str, Backend]:
    """Return engines by name, after a check that they can simulate a world with the parameters.

    Raises:
        ConfigError: If an engine is named twice.
        PluginNotFoundError: If there is none of a name.
        PluginError: If its plugin is broken.
        ModelError: If it cannot load the robot.
        FeatureNotSupportedError: If it lacks something that the robot needs.
        IdentificationError: If something is unknown that no engine's robot can be given.
    """
    odd = [each.name for each in parameters if each.kind in UNSETTABLE]
    if names and odd:
        raise IdentificationError(
            f'No engine can be given "{odd[0]}". Leave it known, or the engines out (--engines).'
        )
    twice = [name for name in names if list(names).count(name) > 1]
    if twice:
        raise ConfigError(f'The engine "{twice[0]}" is named twice.')
    engines = {name: plugins.resolve("backend", name) for name in names}
    for engine in engines.values():
        engine.build(world).close()
    return engines


def world_of(robot: Robot, period: float, gravity: Sequence[float], held: Sequence[str]) -> World:
    """Return the world of a log: a robot in the air, with joints that are held where they are."""
    joints = dict(robot.joints)
    for name in held:
        joints[name] = dataclasses.replace(joints.get(name, JointSettings()), mode="velocity")
    robot = dataclasses.replace(robot, joints=joints, collisions="none")
    return World([robot], period=period, gravity=tuple(gravity), contacts="none")


def refits(
    engines: Mapping[str, Backend],
    world: World,
    model: Model,
    parameters: Sequence[Parameter],
    fit: Fit,
    found: Identification,
) -> list[EngineFit]:
    """Fit the values with the steps of each engine in place of the fit's own.

    Args:
        engines: The engines by name.
        world: The world of the log, as of `world_of`.
        model: Its robot.
        parameters: What was unknown.
        fit: The fit.
        found: What it found.
    """
    problem = _Refit(world, model, parameters, fit, found)
    return [problem.solve(name, engine) for name, engine in engines.items()]


class _Refit:
    def __init__(
        self,
        world: World,
        model: Model,
        parameters: Sequence[Parameter],
        fit: Fit,
        found: Identification,
    ) -> None:
        self._world, self._model, self._fit, self._found = world, model, fit, found
        self._values = np.array([each.value for each in found.estimates])
        self._nominal = np.array([each.nominal for each in parameters])
        self._directions = np.stack([model.direction(each) for each in parameters], axis=1)
        self._lowest = np.array([
            -np.inf if each.lowest is None else each.lowest for each in parameters
        ])  # fmt: skip

    def solve(self, name: str, engine: Backend) -> EngineFit:
        """Return the values that the log tells with an engine."""
        fit, free = self._fit, self._fit.independent
        errors, factor = np.sqrt(np.diag(fit.covariance)), fit.whitener.factor(fit.noise)
        instruments, columns = fit.instruments[:, free], fit.columns[:, free]
        back = np.linalg.inv(instruments.T @ columns)
        moved, last = np.zeros(len(free)), np.full(len(free), np.inf)
        for _ in range(_STEPS):
            values = self._values.copy()
            values[free] += moved
            more, reached = self._difference(engine, np.maximum(values, self._lowest))
            white = fit.whitener.whitened(np.where(reached, more, 0.0), fit.noise, factor)
            last, moved = moved, -back @ (instruments[: len(white)].T @ white)
            if (np.abs(moved - last) < _CLOSE * errors).all():
                break
        compared = fit.used & reached
        power = np.sum(np.where(compared, more, 0.0) ** 2, axis=0)
        told = [
            (row, self._found.estimates[place].name) for row, place in enumerate(free)
            if self._found.estimates[place].error is not None
        ]  # fmt: skip
        return EngineFit(
            name,
            {each: float(self._values[free[row]] + moved[row]) for row, each in told},
            {each: float(moved[row] / errors[row]) for row, each in told},
            np.sqrt(power / np.maximum(compared.sum(axis=0), 1)).tolist(),
            int((fit.used & ~reached).any(axis=1).sum()),
        )

    def _difference(self, engine: Backend, values: Vector) -> tuple[Vector, Array]:
        """Return what torques an engine needs beyond the model's, and whether they suffice.

        Returns:
            Both of shape (samples, joints); torques in N m or N.
        """
        model, path = self._model, self._fit.path
        numbers = model.numbers + self._directions @ (values - self._nominal)
        stencil = model.stencil(path, numbers)
        dry = model.dry(path, stencil, numbers)
        own = model.columns(path, numbers[:, None], path.ends, dry)[..., 0]
        inertia = path.period * stencil[2]  # torque for a change of the velocity at the end
        robot = self._found.applied_to(self._world.robots[0], values.tolist())
        torques, missing = own.copy(), np.zeros_like(own)
        least = _MISSING * np.sqrt(np.mean(own**2, axis=0))
        rows = np.arange(len(own))
        with warnings.catch_warnings(), engine.build(
            dataclasses.replace(self._world, robots=[robot])
        ) as simulation:  # fmt: skip
            for _ in range(_CORRECTIONS):
                lag = path.ends[rows] - _ends(simulation, model.joints, path, torques, rows)
                missing[rows] = np.einsum("kij,kj->ki", inertia[rows], lag)
                rows = rows[(np.abs(missing[rows]) > least).any(axis=1)]
                torques[rows] += missing[rows]
                if not len(rows):
                    break
        return torques - own, np.abs(missing) <= least


def _ends(
    simulation: Simulation, joints: Sequence[str], path: Path, torques: Vector, rows: Array
) -> Vector:
    """Return the velocities after a step from some states of a path, shape (rows, joints)."""
    layout = simulation.layout
    at, to = ([index[name] for name in joints]
              for index in (layout.position_index, layout.velocity_index))  # fmt: skip
    driven = [layout.joints.index(name) for name in joints]
    q, v, command = np.zeros(layout.nq), np.zeros(layout.nv), np.zeros(len(layout.joints))
    ends = np.empty((len(rows), len(joints)))
    moments = zip(path.own[rows], path.velocities[rows], torques[rows], strict=True)
    for place, (position, velocity, torque) in enumerate(moments):
        q[at], v[to], command[driven] = position, velocity, torque
        simulation.set_state(q, v)
        simulation.set_commands(command)
        simulation.step()
        ends[place] = simulation.velocities()[to]
    return ends
