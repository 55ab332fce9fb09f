"""Checks of a log before anything is fitted: what is wrong with it, and where."""

from __future__ import annotations

import itertools

import numpy as np

from physx_core.errors import listed
from physx_core.typing import Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.model import Model, Path
from physx_identify.estimation.smooth import Smoother
from physx_identify.logs.log import Log

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
_FAMILIAR = {180 / np.pi: "degrees", np.pi / 180: "radians taken for degrees", 1e3: "mm or ms"}


def check_log(log: Log, model: Model, parameters: int = 1) -> None:
    """Check that a log can be of a robot.

    Args:
        log: The log.
        model: The robot.
        parameters: Number of unknowns.

    Raises:
        IdentificationError: If joints are missing, unknown or in another order; it is too short; a
            joint does not move; positions are beyond the joint's limits, repeat or have jumps;
            velocities are not those of the positions; or torques are cut off, constant, in another
            unit, order or sign than the robot's; or there is no pose of a floating base, one of a
            fixed base, or one that jumps.
    """
    _check_base(log, model)
    _check_joints(log, model)
    _check_length(log, parameters)
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
            "base_qw). If it hangs or stands, pass Robot(..., fixed_base=True)"
            if model.floating
            else "there is a pose of the base, but the robot's is fixed. If it moves, pass "
            "Robot(..., fixed_base=False) (--floating)"
        )
        raise IdentificationError(f"{log.source}: {what}.")
    if log.base is None:
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
    path = Smoother(log.coordinates)(log.coordinates)
    motion = Path(path, log.period, base=log.base)
    expected = model.columns(motion, model.numbers[:, None], motion.ends)[..., 0][5:-5]
    expected = expected[:, -len(log.joints) :]
    torques = Smoother(log.torques)(log.torques)[1:-1][5:-5]
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
