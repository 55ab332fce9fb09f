"""The next experiment: a motion within the robot's limits that would tell more."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import numpy as np

from physx_core import files
from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.model import GRAVITY, Model, Path
from physx_identify.estimation.noise import Noise, Whitener
from physx_identify.result.identification import Identification
from physx_identify.result.wording import WIDTH, number
from physx_identify.unknowns import Parameter, Unknown
from physx_sim import Robot

_WAVES = 6
_FASTEST_WAVE = 3.0
"""In Hz."""
_STEP, _LONGER = 0.5, 1.5
"""First change of the best motion, relative to a random one; growth of changes that improve it."""
_SHARE = 0.9
"""Share of the robot's limits that the motion uses."""
_RAMP = 0.1
"""Share of the time in which the motion begins from, and ends at, rest."""
_EVALUATED = 400
_CENSORED = 1e3


@dataclass(frozen=True)
class Motion:
    """Joint targets of the next experiment, and what it would tell.

    Attributes:
        joints: Names of the joints.
        period: Time between targets, in s.
        positions: Shape (samples, joints), in rad or m.
        errors: Standard errors to be expected, by parameter.
        before: Standard errors in the log there is, by parameter; infinite: inseparable there.
        inseparable: Parameters that even this motion cannot tell apart.
    """

    joints: tuple[str, ...]
    period: float
    positions: Vector
    errors: Mapping[str, float]
    before: Mapping[str, float]
    inseparable: tuple[str, ...]

    def __str__(self) -> str:
        seconds = len(self.positions) * self.period
        lines = [f"A motion of {seconds:.4g} s would tell, as standard errors:"]
        width = max(map(len, self.errors), default=0)
        for name, error in self.errors.items():
            before = self.before[name]
            now = "inseparable so far" if np.isinf(before) else f"{number(before)} so far"
            lines.append(f"  {name:{width}}  {number(error)}  ({now})")
        if self.inseparable:
            text = f"No motion was found that tells apart: {', '.join(self.inseparable)}."
            lines += textwrap.wrap(text, WIDTH)
        return "\n".join(lines)


def propose(
    found: Identification,
    robot: Robot,
    *,
    duration: float | None = None,
    gravity: Sequence[float] = GRAVITY,
    held: Sequence[str] = (),
    trials: int = 200,
    seed: int = 0,
) -> Motion:
    """Return a motion that would tell more about the parameters of an identification.

    Sums of sines, scaled to the limits of positions, velocities and torques, are tried; that with
    the smallest expected relative errors under the log's noise is improved by small changes.

    Args:
        found: What is known.
        robot: The robot.
        duration: In s; None: that of the log.
        gravity: In m/s².
        held: As in `identify`.
        trials: Number of motions that are tried.
        seed: Seed of their random numbers.

    Raises:
        ConfigError: If the duration or the number of trials is not positive.
    """
    seconds = found.samples * found.period if duration is None else duration
    if not seconds > 0 or trials < 1:
        raise ConfigError(f"A motion of {seconds:g} s from {trials} trials cannot be found.")
    design = _Design(Model(robot, gravity, held), found, seconds)
    random = np.random.default_rng(seed)
    begun = max(1, trials // 4)
    best = min((design.random(random) for _ in range(begun)), key=design.cost)
    cost, step = design.cost(best), _STEP
    for _ in range(trials - begun):
        other = best + step * design.random(random)
        changed = design.cost(other)
        better = changed < cost
        if better:
            best, cost = other, changed
        step *= _LONGER if better else _LONGER**-0.25  # in balance at one success in five
    errors, inseparable = design.errors(design.positions(best))
    before = {e.name: np.inf if e.error is None else e.error for e in found.estimates}
    return Motion(
        design.model.joints,
        found.period,
        design.positions(best),
        {name: error for name, error in errors.items() if name not in inseparable},
        before,
        inseparable,
    )


def expected_errors(
    found: Identification,
    robot: Robot,
    positions: Vector,
    *,
    gravity: Sequence[float] = GRAVITY,
    held: Sequence[str] = (),
) -> dict[str, float]:
    """Return the standard errors that a motion would give under the log's noise.

    Args:
        found: What is known.
        robot: The robot.
        positions: Shape (samples, joints), in rad or m, at the log's period.
        gravity: In m/s².
        held: As in `identify`.
    """
    design = _Design(Model(robot, gravity, held), found, len(positions) * found.period)
    return design.errors(positions)[0]


class _Design:
    def __init__(self, model: Model, found: Identification, seconds: float) -> None:
        model.check_fixed("Proposed motions")
        self.model, self._found = model, found
        self._parameters = _parameters(model, found)
        self._directions = np.stack([model.direction(p) for p in self._parameters], axis=1)
        nominal = np.array([each.nominal for each in self._parameters])
        floor = np.array([
            -np.inf if p.lowest is None else 0.2 * p.nominal for p in self._parameters
        ])  # fmt: skip
        values = np.maximum([each.value for each in found.estimates], floor)
        self._numbers = model.numbers + self._directions @ (values - nominal)
        self._scale = np.array([
            max(abs(each.value), abs(each.nominal), each.error or 0.0) or 1.0
            for each in found.estimates
        ])  # fmt: skip
        noise = found.noise
        regression = np.array(noise.regression, np.float64).reshape(len(model.joints), -1)
        self._noise = Noise(noise.encoder, np.array(noise.innovations), regression)
        self._count = max(60, round(seconds / found.period))
        self._stride = max(1, self._count // _EVALUATED)
        time = np.arange(self._count) * found.period
        first = 1 / (self._count * found.period)
        top = min(_FASTEST_WAVE, 0.1 / found.period)
        self._rates = 2 * np.pi * np.linspace(max(first, 0.1), max(top, 2 * first), _WAVES)
        self._waves = np.concatenate([np.sin(np.outer(time, self._rates)),
                                      np.cos(np.outer(time, self._rates))], axis=1)  # fmt: skip
        ends = np.clip(np.minimum(time, time[-1] - time) / (_RAMP * time[-1]), 0, 1)[:, None]
        self._envelope = ends**3 * (10 - 15 * ends + 6 * ends**2)
        joints = model.movable.model.joints
        # Where the file gives no limit, the log's motion is one.
        far, fast = np.array(found.farthest), np.array(found.fastest)
        lower, upper = (np.array([getattr(j, end) for j in joints]) for end in ("lower", "upper"))
        lower, upper = (
            np.where(np.isfinite(lower), lower, -far),
            np.where(np.isfinite(upper), upper, far),
        )
        self._middle, self._reach = 0.5 * (lower + upper), 0.5 * _SHARE * (upper - lower)
        fastest = np.array([j.max_velocity for j in joints])
        self._fastest = _SHARE * np.where(np.isfinite(fastest) & (fastest > 0), fastest, fast)
        strongest = np.array([j.max_torque for j in joints])
        self._strongest = _SHARE * np.where(strongest > 0, strongest, np.inf)

    def random(self, random: np.random.Generator) -> Vector:
        """Return the amplitudes of a random motion, shape (2 * waves, joints)."""
        shape = (2 * _WAVES, len(self.model.joints))
        return random.standard_normal(shape) / np.tile(self._rates, 2)[:, None]

    def positions(self, amplitudes: Vector) -> Vector:
        """Return a motion, shape (samples, joints), scaled to the robot's limits."""
        moved = self._envelope * (self._waves @ amplitudes)
        speed = np.abs(np.gradient(moved, self._found.period, axis=0)).max(axis=0)
        scale = np.minimum(self._reach / np.abs(moved).max(axis=0), self._fastest / speed)
        moved = moved * scale
        for _ in range(8):
            torques = np.abs(self._torques(self._middle + moved)).max(axis=0)
            if (torques <= self._strongest).all():
                break
            moved *= 0.8
        found: Vector = self._middle + moved
        return found

    def _torques(self, positions: Vector) -> Vector:
        path = Path(positions[:: self._stride], self._found.period * self._stride)
        return self.model.columns(path, self._numbers[:, None], path.ends)[..., 0]

    def cost(self, amplitudes: Vector) -> float:
        """Return the mean logarithm of the expected relative errors."""
        errors, _ = self.errors(self.positions(amplitudes)[:: self._stride])
        relative = np.array(list(errors.values())) / self._scale
        return float(np.mean(np.log(np.minimum(relative, _CENSORED))))

    def errors(self, positions: Vector) -> tuple[dict[str, float], tuple[str, ...]]:
        """Return expected standard errors by name, and which parameters are inseparable."""
        period = self._found.period
        path = Path(positions, period * max(1, round(self._count / len(positions))))
        columns = self.model.columns(path, self._directions, path.ends)
        stencil = self.model.stencil(path, self._numbers)
        self._fill(columns, path, stencil)
        whitener = Whitener(stencil, np.ones(columns.shape[:2], bool))
        rows = whitener.whitened(columns, self._noise)
        priors = [1 / p.deviation if p.deviation else 0.0 for p in self._parameters]
        rows = np.concatenate([rows, np.diag(priors)])
        scaled = rows * self._scale
        values, turns = np.linalg.eigh(scaled.T @ scaled)
        weak = values < 1e-12 * values.max()
        inverse = (turns[:, ~weak] / values[~weak]) @ turns[:, ~weak].T
        lost = np.abs(turns[:, weak]).max(axis=1, initial=0.0) > 1e-3
        errors = np.where(lost, _CENSORED, np.sqrt(np.diag(inverse))) * self._scale
        names = [each.name for each in self._parameters]
        inseparable = tuple(n for n, gone in zip(names, lost, strict=True) if gone)
        return dict(zip(names, errors.tolist(), strict=True)), inseparable

    def _fill(self, columns: Vector, path: Path, stencil: Vector) -> None:
        """Fill in the columns of parameters of the log."""
        own = self.model.columns(path, self._numbers[:, None], path.ends)[..., 0]
        for place, each in enumerate(self._parameters):
            if each.kind == "delay":
                columns[..., place] = -np.gradient(own, path.period, axis=0)
            elif each.kind in ("gain", "bias", "encoder"):
                joint = self.model.joints.index(each.of)
                if each.kind == "encoder":
                    columns[..., place] = -stencil.sum(axis=0)[:, :, joint]
                else:
                    columns[:, joint, place] = -own[:, joint] if each.kind == "gain" else 1.0


def _parameters(model: Model, found: Identification) -> list[Parameter]:
    """Return the parameters of an identification, for a robot."""
    unknowns = list(dict.fromkeys(Unknown(each.kind, each.of) for each in found.estimates))
    known = {each.name: each for each in model.parameters(unknowns)}
    missing = [each.name for each in found.estimates if each.name not in known]
    if missing:
        raise IdentificationError(f'The robot has no "{missing[0]}"; it is not the identified one.')
    return [replace(known[each.name]) for each in found.estimates]


def write_motion(path: str | FilePath, motion: Motion) -> None:
    """Write a motion as CSV: a column of times, and one of targets for each joint.

    Raises:
        IdentificationError: If it cannot be written.
    """
    head = ",".join(["time [s]", *(f"q.{joint}" for joint in motion.joints)])
    times = np.arange(len(motion.positions)) * motion.period
    rows = [
        ",".join(f"{value:.17g}" for value in (time, *row))
        for time, row in zip(times, motion.positions, strict=True)
    ]
    try:
        files.replace(FilePath(path), ("\n".join([head, *rows]) + "\n").encode())
    except OSError as error:
        raise IdentificationError(f"{path} cannot be written: {error}.") from error
