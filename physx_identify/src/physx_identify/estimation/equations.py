"""Equations: torques of a log as linear in its parameters, near values of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from physx_core.typing import Array, Vector
from physx_identify.estimation.base import COORDINATES, Base, Imu
from physx_identify.estimation.model import Model, Path
from physx_identify.estimation.smooth import Smoother, white_noise
from physx_identify.unknowns import Parameter

_LOWEST = 0.2
"""Share of a nominal value below which the path is not corrected with a value."""
_BESIDE = 4
"""Samples next to a contact at which the smoothed path is uncertain, as at the ends of a log."""
_KINK = 3.0 * np.sqrt(20.0)
"""Third difference of positions with contacts, in deviations of their noise, that is a kink."""
_NEAR = 0.01
"""Share of the encoders' errors in differences that derivatives are made of."""
_FAINT = 1e-9
"""Least noise of positions that counts."""
SLOWEST = 0.02
"""Velocity below which dry friction is unknown, in rad/s or m/s."""


@dataclass(frozen=True)
class Data:
    """Measured motion and torques.

    Attributes:
        positions: As in `Path`, shape (samples, coordinates).
        torques: Shape (samples, coordinates), in N m or N.
        period: In s.
        instant: As in `Path`.
        slowest: Velocity below which dry friction is unknown, in rad/s or m/s.
        base: What is known of a floating base, whose coordinates come first.
        flight: Whether all that acts on a floating robot is known.
        wrenches: What acts on links, shape (samples, 6), each of the period before a sample.
        axes: Along which axes, as in `Model.wrenches`.
        contacts: Whether anything else does, shape (samples,), in the period before a sample.
    """

    positions: Vector
    torques: Vector
    period: float
    instant: bool = False
    slowest: float = SLOWEST
    base: Base | Imu | None = None
    flight: bool = False
    wrenches: Mapping[str, Vector] = field(default_factory=dict)
    axes: str = "link"
    contacts: Mapping[str, Array] = field(default_factory=dict)

    @property
    def rows(self) -> slice:
        """Which coordinates have known torques."""
        return slice(0 if self.flight or self.base is None else len(COORDINATES), None)

    def path(self, positions: Vector) -> Path:
        """Return a motion at its times."""
        return Path(positions, self.period, self.instant, self.base)

    def of_steps(self, readings: Vector) -> Vector:
        """Return those of readings that belong to the samples of a path."""
        return readings[1:-1] if self.instant else readings[2:]

    def with_readings(self, stencil: Vector, felt: Sequence[Vector]) -> Vector:
        """Return a stencil with derivatives by wrenches, each (samples, joints, 6), at its end."""
        if not felt:
            return stencil
        more = np.zeros((*stencil.shape[:3], 6 * len(felt)))
        more[1 if self.instant else 2] = np.concatenate(felt, axis=2)
        return np.concatenate([stencil, more], axis=3)


@dataclass(frozen=True)
class Equation:
    """Torques that are linear in parameters: target = columns @ values + residual.

    Attributes:
        instruments: Columns along a path that the noise does not reach, shape (samples, joints,
            parameters).
        columns: Columns of what was measured, of the same shape.
        target: Shape (samples, joints).
        stencil: As in `Model.stencil`, along the same path as the instruments, by positions and
            wrenches in deviations of the encoders, shape (3, samples, joints, readings).
        torques: Of the model along that path, of the same shape as the target.
        doubt: By what dry friction and wrenches differ if they are applied another way, shape
            (samples, joints).
    """

    instruments: Vector
    columns: Vector
    target: Vector
    stencil: Vector
    torques: Vector
    doubt: Vector


class Equations:
    """Equations of a log.

    Attributes:
        model: The robot.
        parameters: What is unknown.
        data: The log.
        nominal: Values of the parameters in the robot's file and settings.
        plain: Which parameters the model's own torques are linear in.
        dry: Which coordinates have dry friction.
    """

    def __init__(self, model: Model, parameters: Sequence[Parameter], data: Data) -> None:
        self.model, self.parameters, self.data = model, parameters, data
        self.nominal = np.array([each.nominal for each in parameters])
        self._directions = np.stack([model.direction(each) for each in parameters], axis=1)
        self._known = model.numbers - self._directions @ self.nominal
        self._lowest = np.array([
            -np.inf if each.lowest is None else _LOWEST * each.nominal for each in parameters
        ])  # fmt: skip
        self._special = [
            (place, each) for place, each in enumerate(parameters)
            if each.kind in ("gain", "bias", "encoder", "delay")
        ]  # fmt: skip
        self.plain = [each.kind not in ("gain", "delay", "encoder") for each in parameters]
        delayed = any(each.kind == "delay" for _, each in self._special)
        self._smooth = Smoother(data.torques) if delayed else None
        joints = model.coordinates
        dry = np.zeros(len(joints), bool)
        rubbing = model.numbers[11 * len(joints) : 13 * len(joints)].reshape(2, -1)
        dry |= rubbing.any(axis=0)
        for each in parameters:
            if each.kind in ("friction", "stribeck"):
                dry[joints.index(each.of)] = True
        self.dry = dry

    @cached_property
    def smoother(self) -> Smoother:
        """What smooths positions as much as those of the log ask for, but not over contacts."""
        data = self.data
        if not data.wrenches and not data.contacts:
            return Smoother(data.positions)
        none = np.zeros(len(data.positions), bool)
        touched: Array = np.logical_or.reduce([none, *data.contacts.values()])
        kinks = _around(touched, 2, 1)  # the step before a flag, and the samples around it
        rough = np.abs(np.diff(data.positions, 3, axis=0)) > _KINK * white_noise(data.positions)
        kinks[2:-1] |= rough.any(axis=1)
        kinks[:-1] |= kinks[1:]
        return Smoother(data.positions, kinks)

    @cached_property
    def struck(self) -> Array:
        """Which torques unknown contacts enter, shape (samples - 2, coordinates)."""
        found = np.zeros((len(self.data.positions), len(self.model.coordinates)), bool)
        for link, on in self.data.contacts.items():
            found |= on[:, None] & self.model.moved(link)
        return _around(found, _BESIDE + 1, _BESIDE)[1:-1]

    def bridged(self, residual: Vector) -> Vector:
        """Return torques, shape (samples - 2, joints), that are straight over unknown contacts."""
        found, rows = residual.copy(), np.arange(len(residual))
        for own, struck in zip(found.T, self.struck[:, self.data.rows].T, strict=True):
            if struck.any() and not struck.all():
                own[struck] = np.interp(rows[struck], rows[~struck], own[~struck])
        return found

    @cached_property
    def scale(self) -> Vector:
        """Noise of each position, then of each wrench, relative to the encoders'."""
        noise, base = self.smoother.noise, 0 if self.data.base is None else len(COORDINATES)
        scale, encoder = np.ones(len(noise)), max(_size(noise[base:]), _FAINT)
        if base:
            for part in (slice(0, 3), slice(3, 6)):
                scale[part] = max(_size(noise[part]), _FAINT) / encoder
        felt = [white_noise(each) / encoder for each in self.data.wrenches.values()]
        return np.concatenate([scale, *felt])

    def scaled(self, errors: Vector) -> Vector:
        """Return errors of the positions, from those of all readings in deviations."""
        found: Vector = (self.scale * errors)[:, : len(self.model.coordinates)]
        return found

    def positions(self, values: Vector) -> Vector:
        """Return measured positions without the encoders' offsets."""
        found = self.data.positions
        for place, each in self._special:
            if each.kind == "encoder":
                offset = values[place] * (np.array(self.model.coordinates) == each.of)
                found = found - offset
        return found

    def late(self, values: Vector) -> float:
        """Return by how many samples the torques are late."""
        delays = (values[place] for place, each in self._special if each.kind == "delay")
        return float(sum(delays)) / self.data.period

    def _torques(self, values: Vector, whole: int) -> Vector:
        """Return measured torques at the times of the positions, shape (samples - 2, joints).

        They are moved by whole samples, or their noise would be smoothed, too; without it, what is
        left of the delay moves them.
        """
        torques = self.data.torques
        time = np.arange(len(torques))
        rows = np.clip(time[1:-1] + whole, 0, time[-1])
        rest = self.late(values) - whole
        if not rest or self._smooth is None:
            return torques[rows]
        smooth = self._smooth(torques)
        late: Vector = torques[rows] + CubicSpline(time, smooth)(rows + rest) - smooth[rows]
        return late

    def _slopes(self, torques: Vector) -> Vector:
        """Return how torques change with a delay, without noise, shape (samples - 2, joints)."""
        assert self._smooth is not None
        found = np.gradient(self._smooth(np.pad(torques, ((1, 1), (0, 0)), mode="edge")), axis=0)
        slopes: Vector = -found[1:-1] / self.data.period
        return slopes

    def at(self, path: Path, raw: Path, values: Vector, whole: int) -> Equation:
        """Return what is linear in the parameters, near values of them.

        Args:
            path: That of the instruments.
            raw: As measured.
            values: Values of the parameters.
            whole: Whole samples of the delay.
        """
        numbers = self._known + self._directions @ np.maximum(values, self._lowest)
        stencil = self.model.stencil(path, numbers)
        dry, doubt, felt = None, np.zeros(path.own.shape), []
        acting = np.zeros((2, *path.own.shape))  # by wrenches: along the path, and as measured
        if (self.dry.any() or self.data.wrenches) and not path.instant:
            # halfway between the two ways of engines
            dry = 0.5 * (self.model.dry(path, stencil, numbers) + np.eye(path.own.shape[1]))
        for link, wrenches in self.data.wrenches.items():
            readings = self.data.of_steps(wrenches)
            by_reading, slopes = self.model.wrenches(path, link, readings, self.data.axes)
            acting += np.einsum("kij,kj->ki", by_reading, readings)
            acting[1] += np.einsum("kij,kj->ki", slopes, raw.own - path.own)
            stencil[1] -= slopes
            felt.append(-by_reading)
        if dry is not None:
            impulses = self.model.friction(path, numbers) - acting[0]
            doubt = np.einsum("kij,kj->ki", dry, impulses) - impulses
            acting = np.einsum("kij,akj->aki", dry, acting)
            felt = [dry @ each for each in felt]
        torques = self._torques(values, whole)
        along, change = self._columns(path, raw, dry)
        instruments, known = self._split(along, stencil, torques)
        own = known - acting[0] + instruments[..., self.plain] @ values[self.plain]
        instruments = self._endogenous(instruments, own)
        columns, known = self._split(along + change, stencil, torques)
        target = torques - known + acting[1]
        for place, each in self._special:
            if each.kind == "gain":
                target = target + columns[..., place]
            elif each.kind in ("delay", "encoder"):
                if each.kind == "encoder":
                    columns[..., place] = instruments[..., place]
                target = target + columns[..., place] * values[place]
        rows = self.data.rows
        return Equation(
            instruments[:, rows],
            columns[:, rows],
            target[:, rows],
            self.scale * self.data.with_readings(stencil, felt)[:, :, rows],
            own[:, rows],
            doubt[:, rows],
        )

    def _columns(self, path: Path, raw: Path, dry: Vector | None) -> tuple[Vector, Vector]:
        """Return columns along a path, with what is known beside them as the last one.

        Returns:
            Shape (samples, joints, parameters + 1); and to first order what they differ by along a
            motion near the path.
        """
        given = np.column_stack([self._directions, self._known])
        difference = _NEAR * (raw.positions - path.positions)
        along, ahead, behind = (
            self.model.columns(each, given, path.ends, dry)
            for each in (
                path,
                dataclasses.replace(path, positions=path.positions + difference),
                dataclasses.replace(path, positions=path.positions - difference),
            )
        )
        return along, (ahead - behind) / (2 * _NEAR)

    def _split(self, columns: Vector, stencil: Vector, torques: Vector) -> tuple[Vector, Vector]:
        """Return the parameters' columns, those of logged quantities too; and what is known."""
        found, known = columns[..., :-1].copy(), columns[..., -1]
        for place, each in self._special:
            if each.kind == "delay":
                found[..., place] = self._slopes(torques)
                continue
            joint = self.model.coordinates.index(each.of)
            if each.kind == "encoder":
                found[..., place] = -stencil.sum(axis=0)[:, :, joint]
            else:
                found[:, joint, place] = -torques[:, joint] if each.kind == "gain" else 1.0
        return found, known

    def _endogenous(self, columns: Vector, own: Vector) -> Vector:
        """Return columns whose torques are the model's own instead of measured ones."""
        found = columns.copy()
        for place, each in self._special:
            if each.kind == "delay":
                found[..., place] = self._slopes(own)
            elif each.kind == "gain":
                joint = self.model.coordinates.index(each.of)
                found[:, joint, place] = -own[:, joint]
        return found

    def priors(self) -> tuple[Vector, Vector]:
        """Return what is known of the parameters beforehand, as rows with variance 1, and means."""
        given = [(n, each) for n, each in enumerate(self.parameters) if each.deviation is not None]
        rows, mean = np.zeros((len(given), len(self.parameters))), np.zeros(len(given))
        for row, (place, each) in enumerate(given):
            assert each.deviation is not None
            rows[row, place], mean[row] = 1 / each.deviation, each.mean / each.deviation
        return rows, mean


def _size(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _around(on: Array, before: int, after: int) -> Array:
    """Return where something is on, with so many samples before and after."""
    found = on.copy()
    for _ in range(before):
        found[:-1] |= found[1:]
    for _ in range(after):
        found[1:] |= found[:-1]
    return found
