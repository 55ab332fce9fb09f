"""Identification: what a log says about a robot; a plain value that is printed and stored."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from physx_identify.errors import IdentificationError
from physx_identify.estimation.structure import ResidualTest
from physx_identify.result import wording
from physx_identify.result.estimates import Combination, EngineFit, Estimate, LogNoise
from physx_sim import JointSettings, Robot
from physx_sim.engines import read_robot

SETTINGS = ("damping", "friction", "armature")
"""Kinds that are settings of a robot's joints."""
UNSETTABLE = ("inertia", "payload", "stribeck")
"""Kinds that are of a robot, but that no option of one holds."""


def masses_of(robot: Robot) -> dict[str, float]:
    """Return the masses of a robot's links in its file, in kg, whatever the robot's factors are."""
    model = read_robot(dataclasses.replace(robot, mass_factors={}))
    return {body.name: body.mass for body in model.bodies}


@dataclass(frozen=True)
class Identification:
    """What a log says about a robot.

    Attributes:
        robot: Its file, or name.
        source: The log.
        joints: Names of the joints.
        samples: Number of samples.
        period: Time between them, in s.
        level: Nominal probability of the intervals, such as 0.95.
        estimates: The parameters.
        combinations: What is told of those that are inseparable.
        noise: Of the log.
        tests: Of what is left.
        converged: Whether the fit converged, from two starts, to the same values.
        residual: Root mean square of what is left of each torque, in N m or N.
        farthest: Largest position of each joint from 0, in rad or m.
        fastest: Largest velocity of each joint, in rad/s or m/s.
        mean: Posterior mean of all parameters.
        covariance: Posterior covariance.
        draws: Physical draws from the posterior, one a row.
        engines: What the log says with other engines' steps.
    """

    robot: str
    source: str
    joints: Sequence[str]
    samples: int
    period: float
    level: float
    estimates: Sequence[Estimate]
    combinations: Sequence[Combination]
    noise: LogNoise
    tests: Sequence[ResidualTest]
    converged: bool
    residual: Sequence[float]
    farthest: Sequence[float]
    fastest: Sequence[float]
    mean: Sequence[float]
    covariance: Sequence[Sequence[float]]
    draws: Sequence[Sequence[float]]
    engines: Sequence[EngineFit] = ()

    @property
    def lacks(self) -> list[str]:
        """What the model lacks, according to the tests that failed."""
        failed = sorted((each for each in self.tests if each.failed), key=lambda x: x.probability)
        return [f"{each.lacks} ({each.joint})" if each.joint else each.lacks for each in failed]

    @property
    def holds(self) -> bool:
        """Whether the intervals may be called by their level."""
        return self.converged and not self.lacks

    @property
    def dependent(self) -> list[str]:
        """Names of the parameters whose values depend on the engine, of those fitted with."""
        return list(dict.fromkeys(name for each in self.engines for name in each.dependent))

    @property
    def verdict(self) -> list[str]:
        """Whether the intervals may be called by their level, and why not, as sentences."""
        return wording.verdict_lines(self.level, self.converged, self.lacks)

    def __getitem__(self, name: str) -> Estimate:
        """Return the estimate of a parameter.

        Raises:
            IdentificationError: If it was not unknown.
        """
        for each in self.estimates:
            if each.name == name:
                return each
        names = ", ".join(each.name for each in self.estimates)
        raise IdentificationError(f'"{name}" was not unknown; that was: {names}.')

    def applied_to(self, robot: Robot, values: Sequence[float] | None = None) -> Robot:
        """Return a robot with the values of masses, damping, friction and armature.

        Args:
            robot: The robot.
            values: Of all parameters; None: the most likely ones.

        Raises:
            IdentificationError: If something else was unknown of the robot itself, which no option
                of a robot holds: inertia, payload, Stribeck friction.
            ModelError: If the robot's file cannot be read.
        """
        given = [each.value for each in self.estimates] if values is None else list(values)
        odd = [e.name for e in self.estimates if e.kind in UNSETTABLE]
        if odd:
            raise IdentificationError(
                f'No option of a robot holds "{odd[0]}": edit its file, or identify its mass.'
            )
        masses, joints, bare = dict(robot.mass_factors), dict(robot.joints), masses_of(robot)
        for each, value in zip(self.estimates, given, strict=True):
            if each.kind == "mass":
                masses[each.of] = value / bare.get(each.of, each.nominal)
            elif each.kind in SETTINGS:
                settings = joints.get(each.of, JointSettings())
                changed: Any = {each.kind: value}
                joints[each.of] = dataclasses.replace(settings, **changed)
        return dataclasses.replace(robot, mass_factors=masses, joints=joints)

    def to_plain(self) -> dict[str, Any]:
        """Return all of it as plain data."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    def to_json(self) -> str:
        """Return all of it as JSON, with what it amounts to.

        That is ``holds``, ``lacks`` and, if there are engines, what of it is ``dependent`` on them.
        """
        amounts = {"holds": self.holds, "lacks": self.lacks, "dependent": self.dependent}
        return json.dumps({**amounts, **self.to_plain()}, indent=1)

    def __str__(self) -> str:
        begin = wording.origin_text(self.robot, self.source, self.samples, self.period)
        lines = textwrap.wrap(begin, wording.WIDTH)
        rows = [wording.HEAD, *map(wording.row_of, self.estimates)]
        lines += ["", *wording.columns(rows, wording.WORDS)]
        if self.combinations:
            lines += ["", f"{wording.TOGETHER}:"]
        for each in self.combinations:
            text = wording.combination_text(each)
            lines += textwrap.wrap(
                f"  {text}", wording.WIDTH, subsequent_indent="    ", break_on_hyphens=False
            )
        lines.append("")
        for text in (wording.noise_text(self.noise), *self.verdict):
            lines += textwrap.wrap(text, wording.WIDTH)
        if self.engines:
            rows = wording.engine_rows(self.engines)
            lines += ["", f"{wording.ELSEWHERE}:", *wording.columns(rows)]
            for text in wording.engine_lines(self.engines):
                lines += textwrap.wrap(text, wording.WIDTH)
        return "\n".join(lines)
