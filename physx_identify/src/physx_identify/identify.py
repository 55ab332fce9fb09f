"""Identifies parameters of a robot from a log."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from physx_core import checks
from physx_core.errors import ConfigError
from physx_core.typing import Array, Vector
from physx_identify.engines import find_engines, refits, world_of
from physx_identify.estimation.equations import SLOWEST
from physx_identify.estimation.fit import Fit, Problem
from physx_identify.estimation.inertia import cholesky_of, from_cholesky, is_physical
from physx_identify.estimation.model import GRAVITY, Model
from physx_identify.estimation.profile import profile_interval
from physx_identify.estimation.structure import structure_tests
from physx_identify.logs.checks import check_log
from physx_identify.logs.log import Log, data_of
from physx_identify.result.estimates import Combination, Estimate, LogNoise
from physx_identify.result.identification import Identification
from physx_identify.unknowns import Parameter, Unknown, as_unknowns
from physx_sim import Robot

DRAWS = 200
"""Number of draws from the posterior that are kept."""
_AGREE = 1.0
"""Largest difference between the values of two starts, in standard errors."""
_BLOCKS = 20
_SHOWN = 1e-6
"""Smallest share in a combination that is named."""
_TRIES = 30
_WEAK = 1e-3
"""Weight of the known inertia where the log tells nothing, per unit of log-Cholesky coordinates."""


def identify(
    log: Log,
    robot: Robot,
    unknowns: Sequence[Unknown | str] | Unknown | str,
    *,
    level: float = 0.95,
    gravity: Sequence[float] = GRAVITY,
    held: Sequence[str] = (),
    instant: bool = False,
    engines: Sequence[str] = (),
    slowest: float = SLOWEST,
    flight: bool = False,
    imu: str = "",
    seed: int = 0,
) -> Identification:
    """Find parameters of a robot in a log, with intervals.

    Args:
        log: Positions, and measured or commanded torques, of all joints.
        robot: The robot as it is known so far; if its base floats, the log has the base's pose, or
            readings of an inertial sensor on it.
        unknowns: What to find, such as ``["mass:hand", "friction"]``; see `Unknown`.
        level: Nominal probability of the intervals.
        gravity: In m/s².
        held: Names of joints that did not move and are not in the log: they are at 0.
        instant: Whether torques are those at the instants of the samples. By default, each is held
            from its sample to the next one, as engines and digital controllers do.
        engines: Names of engines on which the values are fitted anew, such as ``"mujoco"``, to show
            which of them depend on the engine.
        slowest: In rad/s or m/s. Samples at which a joint with dry friction is slower are left out,
            since their friction is unknown, and so are, in any case, the last two steps before a
            joint stops.
        flight: Whether nothing but gravity and the log's wrenches acts on a floating robot. The six
            equations of its base then count, too, each with noise of its own, which takes many
            times as long.
        imu: Name of the frame on the base whose inertial sensor takes the place of the base's pose;
            empty: there is none, or it is in the base's own frame and there is no pose.
        seed: Seed of the draws from the posterior.

    Raises:
        IdentificationError: If the log is bad, see `check_log`; if nothing unknown acts on the
            robot's torques; or if there are engines, but the robot's base floats, something touches
            it, or something is unknown that no engine's robot can be given.
        ConfigError: If an unknown, the level, the slowest velocity or an engine is wrong; or if
            torques are those at instants, which no engine takes.
        ComponentNotFoundError: If the robot has no link, joint or frame on its base of a name.
        PluginNotFoundError: If there is no engine of a name.
        PluginError: If the plugin of an engine is broken.
        ModelError: If the robot cannot be loaded.
        FeatureNotSupportedError: If an engine lacks something that the robot needs.
    """
    if not 0 < level < 1:
        raise ConfigError(f"level is {level!r} but must be between 0 and 1.")
    checks.positive("slowest", slowest)
    model = Model(robot, gravity, held)
    parameters = model.parameters(as_unknowns(unknowns))
    if imu:
        log = log.with_sensor_at(model.sensor_pose(imu))
    check_log(log, model, len(parameters), flight)
    if engines:
        model.check_fixed("Refits on engines")
        log.check_no_contacts("Refits on engines")
    if engines and instant:
        raise ConfigError("Engines hold torques from step to step: leave instant out, or engines.")
    world = world_of(robot, log.period, gravity, held)
    others = find_engines(engines, world, parameters)
    data = data_of(log, instant, slowest, flight)
    problem = Problem(model, parameters, data)
    found = problem.solve()
    again = problem.solve(np.array([each.nominal for each in parameters]), found.noise)
    names = model.coordinates[data.rows]
    summary = _summary(log, robot, parameters, found, again, level, seed, names)
    refitted = refits(others, world, model, parameters, found, summary)
    estimates = summary.estimates
    if summary.converged:
        estimates = [_profiled(each, problem, found, level) for each in estimates]
    return dataclasses.replace(summary, estimates=estimates, engines=refitted)


def _profiled(estimate: Estimate, problem: Problem, found: Fit, level: float) -> Estimate:
    """Return an estimate with the interval of its profile, where that is another one."""
    place = [each.name for each in problem.parameters].index(estimate.name)
    if estimate.error is None:
        return estimate
    freedom = found.freedom[int(np.flatnonzero(found.independent == place)[0])]
    width = float(student.ppf(0.5 + 0.5 * level, freedom))
    ends = profile_interval(problem, found, place, width)
    if ends is None:
        return estimate
    return dataclasses.replace(estimate, low=ends[0], high=ends[1], method="profile")


def _summary(
    log: Log,
    robot: Robot,
    parameters: Sequence[Parameter],
    found: Fit,
    again: Fit,
    level: float,
    seed: int,
    names: Sequence[str],
) -> Identification:
    errors = np.sqrt(np.diag(found.covariance))
    apart = found.values - again.values
    apart = np.abs(apart[found.independent] + found.mixing @ apart[found.dependent]) / errors
    same = len(found.independent) == len(again.independent) and bool((apart < _AGREE).all())
    converged = found.converged and again.converged and same
    width = student.ppf(0.5 + 0.5 * level, found.freedom)
    values = _physical(parameters, found)
    return Identification(
        str(robot.urdf),
        log.source,
        log.joints,
        len(log),
        log.period,
        level,
        _estimates(parameters, found, values, width if converged else None),
        _combinations(parameters, found, width if converged else None),
        _noise(found),
        structure_tests(found, names),
        converged,
        _residual(found),
        np.abs(log.positions).max(axis=0).tolist(),
        np.abs(found.path.velocities).max(axis=0)[-len(log.joints) :].tolist(),
        values.tolist(),
        _covariance(found).tolist(),
        _draws(parameters, found, values, np.random.default_rng(seed)).tolist(),
    )


def _covariance(found: Fit) -> Vector:
    """Return the covariance of all parameters; the held ones do not vary."""
    whole = np.zeros((len(found.values), len(found.values)))
    whole[np.ix_(found.independent, found.independent)] = found.covariance
    return whole


def _estimates(
    parameters: Sequence[Parameter], found: Fit, values: Vector, width: Vector | None
) -> list[Estimate]:
    errors, widths = np.sqrt(np.diag(_covariance(found))), np.full(len(parameters), 2.0)
    if width is not None:
        widths[found.independent] = width
    mixed = {int(place) for place in found.dependent}
    mixed |= {int(found.independent[row]) for row in np.argwhere(_shares(found))[:, 0]}
    blocks = _block_errors(found)
    estimates = []
    for place, each in enumerate(parameters):
        told = (each.name, each.kind, each.of, each.part, each.unit, float(each.nominal))
        value = float(values[place])
        if place in mixed:
            estimates.append(Estimate(*told, value, "inseparable"))
            continue
        error, linear = float(errors[place]), float(found.values[place])
        low = high = None
        if width is not None:
            half = float(widths[place]) * error
            low, high = linear - half, linear + half
            if each.lowest is not None:
                low, high = max(low, each.lowest), max(high, each.lowest)
        hardly = bool(2 * widths[place] * error > abs(linear)) and each.lowest is not None
        ratio = float(blocks[place] / error)
        verdict = "hardly told" if hardly else "told"
        estimates.append(Estimate(*told, value, verdict, error, low, high, ratio))
    return estimates


def _shares(found: Fit) -> Array:
    """Return which fitted parameters hold a share of which held ones."""
    errors = np.sqrt(np.diag(found.covariance))
    size = np.abs(found.values[found.independent]) + errors
    shown: Array = np.abs(found.mixing) > _SHOWN * size[:, None]
    return shown


def _combinations(
    parameters: Sequence[Parameter], found: Fit, width: Vector | None
) -> list[Combination]:
    names = [each.name for each in parameters]
    shares, errors = _shares(found), np.sqrt(np.diag(found.covariance))
    combinations = []
    for row, place in enumerate(found.independent):
        held = [int(column) for column in np.flatnonzero(shares[row])]
        if not held:
            continue
        factors = {names[place]: 1.0}
        factors |= {names[found.dependent[h]]: float(found.mixing[row, h]) for h in held}
        value = float(found.values[place])
        value += float(found.mixing[row, held] @ found.values[found.dependent[held]])
        half = None if width is None else float(width[row] * errors[row])
        ends = (None, None) if half is None else (value - half, value + half)
        combinations.append(Combination(factors, value, *ends))
    for column, place in enumerate(found.dependent):
        if not shares[:, column].any():
            combinations.append(Combination({names[place]: 1.0}, 0.0, None, None))
    return combinations


def _block_errors(found: Fit) -> Vector:
    """Return the standard errors of all parameters by the spread of scores between blocks."""
    z, a = (each[:, found.independent] for each in (found.instruments, found.columns))
    scores = z * found.white[:, None]
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, _BLOCKS)])
    inner = np.linalg.inv(z.T @ a)
    errors = np.zeros(len(found.values))
    covariance = inner @ (sums.T @ sums) @ inner.T
    errors[found.independent] = np.sqrt(np.diag(covariance) * _BLOCKS / (_BLOCKS - 1))
    return errors


def _noise(found: Fit) -> LogNoise:
    noise = found.noise
    steps = 2000
    response = np.zeros((steps, len(noise.torque)))
    response[0] = 1.0
    for row in range(1, steps):
        for lag, weights in enumerate(noise.regression.T, 1):
            if row >= lag:
                response[row] += weights * response[row - lag]
    power = np.sum(response**2, axis=0)
    correlation = np.sum(response[1:] * response[:-1], axis=0) / power
    return LogNoise(
        noise.encoder,
        (noise.torque * np.sqrt(power)).tolist(),
        correlation.tolist(),
        noise.order,
        noise.torque.tolist(),
        noise.regression.tolist(),
    )


def _residual(found: Fit) -> list[float]:
    squares = np.where(found.used, found.residual, 0.0) ** 2
    rms: list[float] = np.sqrt(squares.sum(axis=0) / np.maximum(found.used.sum(axis=0), 1)).tolist()
    return rms


# What is physical ---------------------------------------------------------------------------


def _bodies(parameters: Sequence[Parameter]) -> list[list[int]]:
    """Return the places of the ten numbers of each body whose inertia is unknown."""
    links = dict.fromkeys(each.of for each in parameters if each.kind == "inertia")
    return [
        [n for n, each in enumerate(parameters) if each.kind == "inertia" and each.of == link]
        for link in links
    ]


def _physical(parameters: Sequence[Parameter], found: Fit) -> Vector:
    """Return the most likely values among those that are physical."""
    limited = _clipped(parameters, found.values)
    bodies = _bodies(parameters)
    nominal = np.array([each.nominal for each in parameters])
    if all(is_physical(limited[body]) for body in bodies):
        return limited
    root = np.linalg.cholesky(np.linalg.inv(found.covariance)).T
    inside = [place for body in bodies for place in body]
    others = [place for place in range(len(parameters)) if place not in inside]
    begin = [nominal[others], *(cholesky_of(nominal[body]) for body in bodies)]

    def unpacked(x: Vector) -> Vector:
        values = np.empty(len(parameters))
        values[others] = x[: len(others)]
        for number, body in enumerate(bodies):
            values[body] = from_cholesky(x[len(others) + 10 * number :][:10])
        return values

    def residuals(x: Vector) -> Vector:
        change = unpacked(x) - found.values
        change = change[found.independent] + found.mixing @ change[found.dependent]
        near = _WEAK * (x - start)[len(others) :]  # what the log does not tell stays as it was
        return np.concatenate([root @ change, near])

    start = np.concatenate(begin)
    lowest = [-np.inf if parameters[p].lowest is None else -1e-12 for p in others]
    bounds = np.array([*lowest, *[-np.inf] * 10 * len(bodies)])
    solved = least_squares(residuals, start, bounds=(bounds, np.inf), x_scale="jac")
    return _clipped(parameters, unpacked(solved.x))


def _clipped(parameters: Sequence[Parameter], values: Vector) -> Vector:
    lowest = np.array([-np.inf if each.lowest is None else each.lowest for each in parameters])
    clipped: Vector = np.maximum(values, lowest)
    return clipped


def _draws(
    parameters: Sequence[Parameter], found: Fit, values: Vector, random: np.random.Generator
) -> Vector:
    """Return draws from the posterior; each is drawn again until it is physical.

    What never is, is drawn towards the most likely physical values.
    """
    root, bodies = np.linalg.cholesky(found.covariance), _bodies(parameters)
    lowest = np.array([-np.inf if each.lowest is None else each.lowest for each in parameters])
    draws = np.empty((DRAWS, len(parameters)))
    for row in draws:
        for _ in range(_TRIES):
            row[:] = found.values
            spread = np.sqrt(found.freedom / random.chisquare(found.freedom))
            row[found.independent] += root @ random.standard_normal(len(root)) * spread
            if (row >= lowest).all() and all(is_physical(row[body]) for body in bodies):
                break
        else:
            row[:] = np.maximum(row, lowest)
            while not all(is_physical(row[body]) for body in bodies):
                row[:] = values + 0.5 * (row - values)
    return draws
