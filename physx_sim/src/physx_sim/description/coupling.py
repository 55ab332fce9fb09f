"""Couplings of joints: differentials and other gears, and joints that are locked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from physx_core import checks
from physx_core.errors import ConfigError


@dataclass(frozen=True)
class JointCoupling:
    """Keeps a sum of positions of joints constant: of several, like a differential, or of one.

    Each joint keeps its commands, limits and resistance; what it bears acts on the others. A joint
    that follows one other joint and takes no commands is a `Mimic`.

    Attributes:
        joints: Coefficients of the joints' positions, by name in the file; not 0.
        offset: Sum of coefficients times positions, in rad or m times the coefficients' unit.

    Raises:
        ConfigError: If there is no joint, a coefficient is 0, or an option has the wrong type.
    """

    joints: Mapping[str, float]
    offset: float = 0.0

    def __post_init__(self) -> None:
        checks.store_declared("JointCoupling.", self)
        if not self.joints:
            raise ConfigError("JointCoupling.joints is empty; it needs a joint.")
        for name, coefficient in self.joints.items():
            if not checks.finite(f'JointCoupling.joints["{name}"]', coefficient):
                raise ConfigError(f'JointCoupling.joints["{name}"] must not be 0.')
        checks.finite("JointCoupling.offset", self.offset)
