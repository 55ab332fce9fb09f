"""Unknowns: what of a robot is to be found in a log."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError

LINKS = ("mass", "inertia", "payload")
JOINTS = ("damping", "friction", "stribeck", "armature", "gain", "bias", "encoder")
KINDS = (*LINKS, *JOINTS, "delay")
_TEXT = re.compile(r"(?P<kind>\w+)(:(?P<of>[^=]+))?(=(?P<mean>[^,]+),(?P<deviation>[^,]+))?")


@dataclass(frozen=True)
class Unknown:
    """Something unknown, of one link or joint, or of all.

    Attributes:
        kind: Of a link: ``"mass"`` in kg, with moments of inertia in proportion; ``"inertia"``, all
            ten numbers of its mass, center and moments; ``"payload"``, a point mass in kg at the
            origin of its frame. Of a joint: ``"damping"``, ``"friction"`` (Coulomb) and
            ``"armature"`` as in `JointSettings`; ``"stribeck"``, friction that vanishes with speed;
            ``"gain"``, the torque for a logged torque of 1; ``"bias"``, an offset of the logged
            torque in N m or N; ``"encoder"``, an offset of the logged position in rad or m. Of the
            log: ``"delay"``, by which its torques are late relative to its positions, in s.
        of: Name of the link or joint; empty: all.
        mean: What is known beforehand of its value, in its unit; only with `deviation`.
        deviation: Standard deviation of what is known beforehand; None: nothing is.

    Raises:
        UnknownOptionError: If there is no such kind.
        ConfigError: If a number is out of range, or there is a prior for more than one number.
    """

    kind: str
    of: str = ""
    mean: float = 0.0
    deviation: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownOptionError("Unknown.kind", [str(self.kind)], KINDS)
        checks.store_declared("Unknown.", self)
        checks.finite("Unknown.mean", self.mean)
        if self.deviation is not None:
            checks.positive("Unknown.deviation", self.deviation)
            if self.kind == "inertia":
                raise ConfigError("A prior is for one number, so not for an inertia.")

    @classmethod
    def parse(cls, text: str) -> Unknown:
        """Return an unknown from ``kind``, ``kind:name`` or ``kind:name=mean,deviation``.

        Raises:
            ConfigError: If the text has another form.
        """
        found = _TEXT.fullmatch(text)
        try:
            if found is not None:
                given = found.groupdict(default="")
                prior = (
                    (float(given["mean"]), float(given["deviation"]))
                    if given["mean"]
                    else (0.0, None)
                )
                return cls(given["kind"], given["of"], *prior)
        except ValueError:
            pass
        raise ConfigError(
            f'The unknown "{text}" must read kind, kind:name or kind:name=mean,deviation, such as '
            '"friction", "mass:hand" or "mass:hand=0.7,0.1".'
        )


@dataclass(frozen=True)
class Parameter:
    """One unknown number.

    Attributes:
        kind: As in `Unknown`.
        of: Name of the link or joint; empty for the delay.
        part: Which number of an inertia, as in `inertia.TEN`; empty otherwise.
        unit: Its unit.
        nominal: Its value in the robot's file and settings.
        mean: What is known beforehand.
        deviation: Its standard deviation; None: nothing is known beforehand.
    """

    kind: str
    of: str
    part: str
    unit: str
    nominal: float
    mean: float = 0.0
    deviation: float | None = None

    @property
    def name(self) -> str:
        """Its name in results, such as ``"friction elbow"``."""
        return " ".join(word for word in (self.part or self.kind, self.of) if word)

    @property
    def lowest(self) -> float | None:
        """Its physical limit; None: it has none."""
        positive = self.kind in ("mass", "payload", "damping", "friction", "armature", "gain")
        return 0.0 if positive or self.part == "mass" else None


def as_unknowns(given: Sequence[Unknown | str] | Unknown | str) -> list[Unknown]:
    """Return unknowns, given as such or as texts."""
    several = [given] if isinstance(given, (str, Unknown)) else given
    found = [each if isinstance(each, Unknown) else Unknown.parse(each) for each in several]
    if not found:
        raise ConfigError(f"Nothing is unknown. Name what to find: {', '.join(KINDS)}.")
    return found
