"""Refits on other engines: which values depend on the engine whose steps the fit takes.

The fit's torques are those of Pinocchio's dynamics in steps of the log's period; an engine solves
friction, damping and limits of a step in its own way. It gets the identified robot and each state
of the fit's path, and the torques are found that bring it to the next one. They take the place of
the fit's own, and the values are fitted anew, along the same path and with the same noise: nothing
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
from physx_identify.estimation.noise import Whitener
from physx_identify.result.estimates import EngineFit
from physx_identify.result.identification import SETTINGS, UNSETTABLE, Identification
from physx_identify.unknowns import Parameter
from physx_sim import Backend, JointSettings, Robot, Simulation, World

_STEPS, _CLOSE = 10, 0.02
"""Most steps of a refit; and how small its last one is, in standard errors."""
_CORRECTIONS, _EXACT = 20, 0.01
"""Most corrections of torques; and how exact they are, in deviations of their noise."""
_LIGHTEST = 0.01
"""Least mass that an engine's link gets, relative to that of the robot's file."""
_FAINTEST = 1e-6
"""Least noise of torques that counts, relative to the torques."""


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
        self._world, self._joints, self._fit, self._found = world, model.joints, fit, found
        kinds, nominal = zip(*((each.kind, each.nominal) for each in parameters), strict=True)
        self._of_robot = np.array([kind in ("mass", *SETTINGS) for kind in kinds])
        self._lowest = np.where(np.array(kinds) == "mass", _LIGHTEST * np.array(nominal), 0.0)
        numbers = model.numbers + sum(
            model.direction(each) * (max(value, lowest) - each.nominal)
            for each, value, lowest in zip(parameters, fit.values, self._lowest, strict=True)
        )
        self._stencil = model.stencil(fit.path, numbers)
        self._inertia = fit.path.period * self._stencil[2]  # torque for a change of the velocity
        self._own = fit.torques.copy()
        for each, value in zip(parameters, fit.values, strict=True):
            if each.kind == "bias":
                self._own[:, model.joints.index(each.of)] -= value

    def solve(self, name: str, engine: Backend) -> EngineFit:
        """Return the values that the log tells with an engine."""
        fit, free = self._fit, self._fit.independent
        errors = np.sqrt(np.diag(fit.covariance))
        moved, last = np.zeros(len(free)), np.full(len(free), np.inf)
        for _ in range(_STEPS):
            values = fit.values.copy()
            values[free] += moved
            values[self._of_robot] = np.maximum(values, self._lowest)[self._of_robot]
            more, reached = self._difference(engine, values)
            compared = fit.used & reached
            last, moved = moved, self._moved(more, compared)
            if (np.abs(moved - last) < _CLOSE * errors).all():
                break
        power = np.sum(np.where(compared, more, 0.0) ** 2, axis=0)
        told = [
            (row, self._found.estimates[place].name) for row, place in enumerate(free)
            if self._found.estimates[place].error is not None
        ]  # fmt: skip
        return EngineFit(
            name,
            {each: float(fit.values[free[row]] + moved[row]) for row, each in told},
            {each: float(moved[row] / errors[row]) for row, each in told},
            np.sqrt(power / np.maximum(compared.sum(axis=0), 1)).tolist(),
            int((fit.used & ~reached).any(axis=1).sum()),
        )

    def _moved(self, more: Vector, used: Array) -> Vector:
        """Return by what the values change with more torques, shape (samples, joints)."""
        whitener = Whitener(self._stencil, used)
        together = np.concatenate([self._fit.regressors, more[..., None]], axis=2)
        white = whitener.whitened(np.where(used[..., None], together, 0.0), self._fit.noise)
        known = self._fit.known.copy()
        known[:, -1] = 0.0
        white = np.concatenate([white, known])
        change = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
        moved: Vector = -change.astype(np.float64)
        return moved

    def _difference(self, engine: Backend, values: Vector) -> tuple[Vector, Array]:
        """Return what torques an engine needs beyond the fit's, and whether they suffice.

        Returns:
            Both of shape (samples, joints); torques in N m or N.
        """
        path, free = self._fit.path, self._fit.independent
        change = np.where(self._of_robot, values - self._fit.values, 0.0)[free]
        own = self._own + self._fit.regressors @ change
        robot = self._found.applied_to(self._world.robots[0], values.tolist())
        torques, missing = own.copy(), np.zeros_like(own)
        least = _EXACT * np.maximum(self._fit.noise.torque, _FAINTEST * np.std(own, axis=0))
        rows = np.arange(len(own))
        with warnings.catch_warnings(), engine.build(
            dataclasses.replace(self._world, robots=[robot])
        ) as simulation:  # fmt: skip
            for _ in range(_CORRECTIONS):
                lag = path.ends[rows] - _ends(simulation, self._joints, path, torques, rows)
                missing[rows] = np.einsum("kij,kj->ki", self._inertia[rows], lag)
                rows = rows[(np.abs(missing[rows]) > least).any(axis=1)]
                torques[rows] += missing[rows]
                if not len(rows):
                    break
        return torques - own, np.abs(missing) <= least / _EXACT


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
