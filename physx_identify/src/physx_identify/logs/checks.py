"""Checks of a log before anything is fitted: what is wrong with it, and where."""

from __future__ import annotations

import itertools

import numpy as np

from physx_core.errors import listed
from physx_core.rotations import from_rotation_vector_rows, multiply, rotate_rows
from physx_core.typing import Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import Base, Imu
from physx_identify.estimation.model import Model
from physx_identify.estimation.smooth import Smoother
from physx_identify.logs.log import Log, data_of

_LEAST = 50
_LEAST_PER_PARAMETER = 10
_STILL_RANGE = 1e-6
_CLIPPED = 0.02
"""Share of equal extreme torques above which they were cut off."""
_REPEATED = 0.3
"""Share of samples equal to the one before, of joints that move."""
_FAST, _SLOW = 2e-5, 0.2
_RATIO = 1.5
_WELL = 0.5
"""Correlation above which velocities are those of a joint."""
_TOO_LARGE = 20.0
_TURN, _LEAP = 0.2, 0.02
"""Turn of the base from sample to sample in rad, and change of its movement in m, of a jump."""
_CLEAR, _UNLIKE = 0.2, 0.02
"""Share of what is unlike the model, and least of it, that shows that torques are exchanged."""
_SHOWN_SIGN = -0.5
_IN_G = 0.3
"""Largest difference from 1 of a specific force in g, of a robot that does not fall."""
_SPREAD = 0.01
"""Least share of the specific force that changes in the world, to blame the gyroscope for it."""
_TURNS = {
    1.0: "",
    -1.0: "angular velocities have the opposite sign.",
    np.pi / 180: "angular velocities are in deg/s. Convert them to rad/s.",
    180 / np.pi: "angular velocities in rad/s were taken for deg/s. Convert them to rad/s.",
}
"""Factors of wrong angular velocities, and what is wrong."""
_TOO_LARGE_FORCE = 3.0
_FAMILIAR = {180 / np.pi: "degrees", np.pi / 180: "radians taken for degrees", 1e3: "mm or ms"}


def check_log(log: Log, model: Model, parameters: int = 1, flight: bool = False) -> None:
    """Check that a log can be of a robot.

    Args:
        log: The log.
        model: The robot.
        parameters: Number of unknowns.
        flight: Whether a floating base may fall freely.

    Raises:
        IdentificationError: If joints are missing, unknown or in another order; it is too short; a
            joint does not move; positions are beyond the joint's limits, repeat or have jumps;
            velocities are not those of the positions; or torques are cut off, constant, in another
            unit, order or sign than the robot's; or there is no pose of a floating base, one of a
            fixed base, or one that jumps; or the readings of its inertial sensor are in another
            unit or of another sign, or lack gravity; or wrenches have another unit or sign, act on
            a link that does not move, or are along unknown axes; or contacts leave too few samples.
        ComponentNotFoundError: If wrenches or contacts are of a link that the robot has not.
    """
    _check_base(log, model)
    _check_joints(log, model)
    _check_length(log, parameters)
    if log.gyroscope is not None and log.base_positions is None:
        _check_sensor(log, model, flight)
    _check_links(log, model, parameters)
    _check_positions(log, model)
    if log.velocities is not None:
        _check_velocities(log, log.velocities)
    _check_torques(log, model)


def _check_joints(log: Log, model: Model) -> None:
    if log.joints == model.joints:
        return
    if set(log.joints) == set(model.joints):
        raise IdentificationError(
            f"{log.source} has the joints in the order {listed(log.joints)}, the robot in "
            f"the order {listed(model.joints)}. Arrange the columns like the robot."
        )
    missing = [name for name in model.joints if name not in log.joints]
    more = [name for name in log.joints if name not in model.joints]
    what = f"lacks the joint {missing[0]}" if missing else f"has a joint {more[0]}"
    raise IdentificationError(
        f"{log.source} {what}, which the robot has {'' if missing else 'not'}: "
        f"{listed(model.joints)}. Name joints that did not move: held (--held)."
    )


def _check_base(log: Log, model: Model) -> None:
    if model.floating is not (log.base is not None):
        what = (
            f'robot "{model.robot.name}" floats, but there is no pose of its base (base_x ... '
            "base_qw) and no inertial sensor on it. If it hangs or stands, pass Robot(..., "
            "fixed_base=True)"
            if model.floating
            else "there is a pose of the base, but the robot's is fixed. If it moves, pass "
            "Robot(..., fixed_base=False) (--floating)"
        )
        raise IdentificationError(f"{log.source}: {what}.")
    if not isinstance(log.base, Base):
        return
    for what, values, most in (
        ("turns by", np.diff(log.base.angles, axis=0), _TURN),
        ("moves by", np.diff(log.coordinates[:, :3], 2, axis=0), _LEAP),
    ):
        sizes = np.linalg.norm(values, axis=1)
        worst = int(np.argmax(sizes))
        usual = float(np.sort(sizes)[-max(5, len(sizes) // 50)])
        if sizes[worst] > most and sizes[worst] > 10 * usual:
            raise IdentificationError(
                f"{log.source}: the base {what} {sizes[worst]:.3g} at {worst * log.period:.4g} s: "
                "a sample is wrong or missing. Cut the log there."
            )


def _check_length(log: Log, parameters: int) -> None:
    least = max(_LEAST, _LEAST_PER_PARAMETER * parameters)
    if len(log) < least:
        raise IdentificationError(
            f"{log.source} has {len(log)} samples; {parameters} unknowns need at least {least}."
        )
    if not _FAST <= log.period <= _SLOW:
        raise IdentificationError(
            f"{log.source} has a sample every {log.period:g} s, which no log of a robot has. Is "
            "time in ms? Give the period in s."
        )


def _check_positions(log: Log, model: Model) -> None:
    joints = model.movable.model.joints
    for number, joint in enumerate(joints):
        own = log.positions[:, number]
        where = f"{log.source}: positions of {joint.name}"
        if np.ptp(own) < _STILL_RANGE:
            raise IdentificationError(
                f"{where} never change. Move it, or leave it out and name it: held (--held)."
            )
        repeated = float(np.mean(np.diff(own) == 0))
        if repeated > _REPEATED and np.ptp(own) > 1e-3:
            raise IdentificationError(
                f"{where} repeat in {100 * repeated:.0f} % of the samples: the encoder is slower "
                "or coarser than the log. Keep every second, third ... sample only."
            )
        span = joint.upper - joint.lower
        beyond = max(joint.lower - own.min(), own.max() - joint.upper)
        if np.isfinite(span) and beyond > 0.1 * span:
            low, high = joint.lower, joint.upper
            raise IdentificationError(
                f"{where} reach from {own.min():.4g} to {own.max():.4g}, but the joint's limits "
                f"are {low:.4g} and {high:.4g} {joint.unit}. Degrees, or another joint?"
            )
        if joint.unit == "rad" and np.abs(own).max() > _TOO_LARGE:
            raise IdentificationError(
                f"{where} reach {np.abs(own).max():.4g} rad. Are they in degrees? Then say so: a "
                "unit in the file, as in  q.elbow [deg]."
            )
        steps = np.abs(np.diff(own, 2))
        worst = int(np.argmax(steps))
        usual = float(np.sort(steps)[-max(5, len(steps) // 50)])
        if steps[worst] > 30 * usual + 1e-9 and steps[worst] > 0.01:
            raise IdentificationError(
                f"{where} jump by {steps[worst]:.3g} {joint.unit} at {worst * log.period:.4g} s: "
                "a sample is wrong or missing. Cut the log there."
            )


def _check_velocities(log: Log, velocities: Vector) -> None:
    moved = np.gradient(Smoother(log.positions)(log.positions), log.period, axis=0)
    alike = _correlations(velocities, moved)
    for number, joint in enumerate(log.joints):
        where = f"{log.source}: velocities of {joint}"
        if alike[number, number] < -_WELL:
            raise IdentificationError(f"{where} have the opposite sign of its positions' change.")
        other = int(np.argmax(np.abs(alike[number])))
        if other != number and abs(alike[number, number]) < _WELL < abs(alike[number, other]):
            raise IdentificationError(
                f"{where} are those of {log.joints[other]}: columns are in another order."
            )
        if alike[number, number] < _WELL:
            raise IdentificationError(
                f"{where} are not the change of its positions. Leave them out."
            )
        ratio = float(np.std(velocities[:, number]) / np.std(moved[:, number]))
        if not 1 / _RATIO < ratio < _RATIO:
            unit = next((n for f, n in _FAMILIAR.items() if abs(ratio / f - 1) < 0.2), "")
            raise IdentificationError(
                f"{where} are {ratio:.3g} times the change of its positions: another unit"
                f"{f' ({unit})' if unit else ''}."
            )


def _check_torques(log: Log, model: Model) -> None:
    for number, joint in enumerate(log.joints):
        own = log.torques[:, number]
        where = f"{log.source}: torques of {joint}"
        if np.ptp(own) == 0:
            raise IdentificationError(f"{where} never change. Is it the right column?")
        for end in (own.max(), own.min()):
            share = float(np.mean(own == end))
            if share > _CLIPPED and len(np.unique(own)) > 10:
                raise IdentificationError(
                    f"{where} are {end:.4g} in {100 * share:.0f} % of the samples: cut off by a "
                    "limit, so the true ones are unknown. Cut the log there, or move less."
                )
    torques, expected, acting = _compared(log, model)
    expected = expected - sum(acting.values())
    alike = _correlations(torques, expected)
    _check_order(log, alike)
    ratios = np.std(torques, axis=0) / np.maximum(np.std(expected, axis=0), 1e-9)
    ratio = float(np.median(ratios))
    clear = float(np.median(np.diagonal(alike))) > _WELL
    if clear and not 1 / _TOO_LARGE < ratio < _TOO_LARGE:
        raise IdentificationError(
            f"{log.source}: torques are {ratio:.3g} times those of the robot as it is known. Are "
            "they in another unit (N mm, A), or at the other side of the gear? Convert them to N m."
        )


def _compared(log: Log, model: Model) -> tuple[Vector, Vector, dict[str, Vector]]:
    """Return torques of the joints, smoothed, where nothing unknown touches the robot.

    Returns:
        As logged; those of the model's motion; and those of each link's wrench.
    """
    data = data_of(log)
    path = data.path(Smoother(data.positions)(data.positions))
    smooth = Smoother(log.torques)
    moves = model.columns(path, model.numbers[:, None], path.ends)[..., 0]
    given = {link: data.of_steps(each) for link, each in data.wrenches.items()}
    acting = {
        link: np.einsum("kij,kj->ki", model.wrenches(path, link, each, data.axes)[0], each)
        for link, each in given.items()
    }
    kept = np.ones(len(path.own), bool)
    for each in data.contacts.values():
        kept &= data.of_steps(each) == 0
    kept[:5] = kept[-5:] = False
    joints = slice(-len(log.joints), None)
    of_wrenches = {link: each[kept, joints] for link, each in acting.items()}
    return smooth(log.torques)[1:-1][kept], moves[kept, joints], of_wrenches


def _check_sensor(log: Log, model: Model, flight: bool) -> None:
    """Check that the base turns as its specific force does."""
    assert log.gyroscope is not None
    assert log.accelerometer is not None
    weight, source = float(np.linalg.norm(model.gravity)), log.source
    felt = float(np.median(np.linalg.norm(log.accelerometer, axis=1)))
    if weight and not flight and abs(felt - 1.0) < _IN_G and weight > 2.0:
        raise IdentificationError(
            f"{source}: the accelerometer reads {felt:.3g} m/s². Is it in g? Then say so: a unit "
            "in the file, as in  accelerometer_x [g]."
        )
    if not flight and felt < 0.5 * weight:
        raise IdentificationError(
            f"{source}: the accelerometer reads {felt:.3g} m/s², so gravity is missing: at rest, "
            f"it is {weight:.3g} upwards. If the robot falls freely, pass flight (--flight)."
        )
    spread = {factor: _spread(log, factor) for factor in _TURNS}
    best = min(spread, key=lambda factor: spread[factor])
    if spread[best] < _CLEAR * spread[1.0] and spread[1.0] > _SPREAD:
        raise IdentificationError(
            f"{source}: specific force and angular velocity of the base do not belong together: "
            f"{_TURNS[best]}"
        )


def _spread(log: Log, factor: float) -> float:
    """Return how much of the specific force is not constant in the world for a second.

    Args:
        log: The log.
        factor: What angular velocities are multiplied by.
    """
    assert log.gyroscope is not None
    assert log.accelerometer is not None
    count = max(int(1.0 / log.period), 10)
    left, whole = 0.0, 0.0
    for first in range(0, len(log) - count + 1, count):
        turns, part = [(0.0, 0.0, 0.0, 1.0)], slice(first, first + count)
        for step in from_rotation_vector_rows(factor * log.period * log.gyroscope[part]).tolist():
            turns.append(multiply(turns[-1], step))
        force = rotate_rows(np.array(turns[1:]), log.accelerometer[part])
        left += float(np.sum((force - force.mean(axis=0)) ** 2))
        whole += float(np.sum(force**2))
    return left / whole if whole else 0.0


def _check_links(log: Log, model: Model, parameters: int) -> None:
    struck = np.zeros((len(log), len(model.coordinates)), bool)
    for link, on in log.contacts.items():
        struck |= (on != 0)[:, None] & model.moved(link)
    left = int(np.sum(~struck.all(axis=1)))
    least = max(_LEAST, _LEAST_PER_PARAMETER * parameters)
    if log.contacts and left < least:
        raise IdentificationError(
            f"{log.source}: contacts of {listed(log.contacts)} leave {left} samples; {parameters} "
            f"unknowns need at least {least}."
        )
    for link in log.wrenches:
        if not model.moved(link).any():
            raise IdentificationError(
                f"{log.source}: no joint moves {link}, so its wrench says nothing. Leave it out."
            )
    if log.wrenches and log.axes == "world" and isinstance(log.base, Imu):
        raise IdentificationError(
            f"{log.source}: an inertial sensor does not tell the axes of the world. Give wrenches "
            "along those of their links (--axes link)."
        )
    if not log.wrenches:
        return
    torques, moves, acting = _compared(log, model)
    missing = moves - torques  # what wrenches should be
    for link, own in acting.items():
        others = missing - sum(each for name, each in acting.items() if name != link)
        size = float(np.sum(own**2))
        share = float(np.sum(own * others)) / size if size else 1.0
        clear = abs(share) * np.sqrt(size) > _WELL * np.linalg.norm(others)
        if clear and share < 0:
            raise IdentificationError(
                f"{log.source}: the force on {link} has the opposite sign of what moves the robot "
                "there. It must be the one on the robot, not of it."
            )
        if clear and not 1 / _TOO_LARGE_FORCE < share < _TOO_LARGE_FORCE:
            raise IdentificationError(
                f"{log.source}: the force on {link} is {1 / share:.3g} times what moves the robot "
                "there. Is it in another unit (kN, kg)? Convert it to N, moments to N m."
            )


def _check_order(log: Log, alike: Vector) -> None:
    """Check order and sign of the torques by their likeness with the model's."""
    joints = range(len(alike))
    own = np.diagonal(alike)
    wrong = [joint for joint in joints if own[joint] < _SHOWN_SIGN]
    if wrong:
        raise IdentificationError(
            f"{log.source}: torques of {log.joints[wrong[0]]} have the opposite sign of the "
            f"robot's (correlation {own[wrong[0]]:.2f})."
        )
    unlike = 1 - alike**2
    for first, second in itertools.combinations(joints, 2):
        now = unlike[first, first] + unlike[second, second]
        swapped = unlike[first, second] + unlike[second, first]
        signs = min(alike[first, second], alike[second, first])
        if swapped < _CLEAR * now and now > _UNLIKE and signs > _WELL:
            raise IdentificationError(
                f"{log.source}: torques of {log.joints[first]} and {log.joints[second]} seem to be "
                "exchanged."
            )


def _correlations(left: Vector, right: Vector) -> Vector:
    """Return the correlation of each column with each column."""
    normal = []
    for values in (left, right):
        centered = values - values.mean(axis=0)
        normal.append(centered / np.maximum(np.linalg.norm(centered, axis=0), 1e-12))
    found: Vector = normal[0].T @ normal[1]
    return found
