"""Converts positions or velocities to the accelerations that a PD controller takes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy import absolute, copysign, less, maximum, minimum, multiply, sqrt, subtract

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.blocks.block import ControllerBlock
from physx_gym.blocks.pd_controller import PDController

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class PDAdapter(ControllerBlock):
    """Controls a PD controller's targets by position or velocity instead of acceleration.

    Its action: positions (`order` 0) or velocities (`order` 1) of the targets, shape (motors,). In
    each of its periods, it sets the constant acceleration that brings the targets' velocities to
    the desired ones within the period; with `order` 0, these are the velocities that would reach
    the desired positions in one period. With `is_instantaneous`, it works at the controller's own
    period instead, and moves as fast as the controller's bounds allow: to a position without
    overshoot, to a velocity at once.

    Attributes:
        controller: The PD controller below.
    """

    def __init__(
        self,
        name: str,
        env: PipelineEnv,
        *,
        update_ratio: int = -1,
        order: int = 1,
        is_instantaneous: bool = False,
        deadband: Any = 0.0,
    ) -> None:
        """Adapt the action of a PD controller.

        Args:
            name: Name within the pipeline.
            env: The environment below: a `ControlledEnv` with a `PDController`.
            update_ratio: See `Block`; not used with `is_instantaneous`.
            order: 0: the action is positions; 1: velocities.
            is_instantaneous: Whether to move as fast as the controller's bounds allow.
            deadband: Changes of position, or velocities, below which a target does not move; in
                rad, m, rad/s or m/s: a number, or one for each motor.

        Raises:
            ConfigError: If an option is invalid, or there is no PD controller directly below.
        """
        super().__init__(name, env, update_ratio=1 if is_instantaneous else update_ratio)
        if order not in (0, 1):
            raise ConfigError(f'PDAdapter "{name}": order is {order!r} but must be 0 or 1.')
        self.order, self.is_instantaneous, self.deadband = order, is_instantaneous, deadband
        self.refresh_connection()

    def connect(self) -> None:
        """Read the bounds of the controller's targets.

        Raises:
            ConfigError: If the environment is not a `ControlledEnv` with a `PDController`, or the
                deadband is invalid.
        """
        controller = getattr(self.env, "controller", None)
        if not isinstance(controller, PDController):
            raise ConfigError(
                f'PDAdapter "{self.name}" must be directly on a ControlledEnv with a PDController.'
            )
        self.controller = controller
        low, high = controller.targets.bounds
        count = len(controller.joints.names)
        if self.order == 0:
            low[0], high[0] = controller.lower, controller.upper
        self.action_space = spaces.Box(low[self.order], high[self.order], dtype=np.float64)
        self._deadband = controller.joints.option("deadband", self.deadband)
        self._is_dead = bool(self._deadband.any())
        self._most = controller.max_acceleration
        self._least, self._zero = -self._most, np.zeros(count)
        self._rate, self._double, self._half = np.zeros(count), 2 * self._most, np.zeros(count)
        self._wanted, self._size = np.zeros(count), np.zeros(count)
        self._close = np.zeros(count, np.bool_)

    def setup(self) -> None:
        """Compute the periods."""
        super().setup()
        self._rate[:] = 1 / self.period
        self._half[:] = 0.5 * self.period * self._most

    @property
    def fieldnames(self) -> list[str]:
        """Names of the desired positions or velocities."""
        kind = ("wantedPosition", "wantedVelocity")[self.order]
        return [f"{kind}.{name}" for name in self.controller.joints.names]

    def compute_command(self, action: Vector, command: Vector) -> None:
        """Write the accelerations of the targets, shape (motors,), in rad/s² or m/s²."""
        wanted, targets = action, self.controller.targets
        if self.order == 0:
            wanted = self._wanted
            subtract(action, targets.positions, wanted)
        if self._is_dead:
            wanted = self._without_small(wanted)
        if self.order == 0:
            if self.is_instantaneous:
                self._slow_down(wanted)
            else:
                multiply(wanted, self._rate, wanted)
        subtract(wanted, targets.velocities, command)
        multiply(command, self._rate, command)
        minimum(command, self._most, out=command)
        maximum(command, self._least, out=command)

    def _without_small(self, wanted: Vector) -> Vector:
        """Return the desired values, 0 within the deadband."""
        absolute(wanted, self._size)
        less(self._size, self._deadband, self._close)
        np.copyto(self._wanted, wanted)
        self._wanted[self._close] = 0.0
        return self._wanted

    def _slow_down(self, wanted: Vector) -> None:
        """Replace distances by the highest velocities from which the targets can stop there."""
        size = self._size
        absolute(wanted, size)
        direct = size * self._rate
        multiply(size, self._double, size)
        sqrt(size, size)
        subtract(size, self._half, size)
        # Within the last half period of braking it goes there directly.
        maximum(size, minimum(direct, self._half), out=size)
        copysign(size, wanted, wanted)
