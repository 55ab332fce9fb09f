"""Observer block that estimates the attitudes of IMUs from their measurements."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core import checks
from physx_core.errors import ConfigError
from physx_core.rotations import to_roll_pitch_yaw
from physx_core.typing import Vector
from physx_gym.blocks.attitude_features import attitude_fieldnames, attitude_space
from physx_gym.blocks.block import ObserverBlock
from physx_gym.blocks.mahony import (
    Gains,
    advance,
    advance_rows,
    attitude_from_gravity,
    remove_twist,
)
from physx_sim import Imu

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


_STATE = struct.Struct("13d")
"""Writes plain numbers into an array faster than NumPy."""


class MahonyFilter(ObserverBlock):
    """Estimates the attitudes of IMUs from the angular velocities and accelerations they measure.

    Its features have a column for each IMU: ``orientation``, quaternions x, y, z, w of the sensors
    in the world; ``angular_velocity``, the measured one minus its estimated bias, in rad/s, along
    the sensors' axes; with `compute_rpy`, also ``roll_pitch_yaw``, in rad. Its state: the estimated
    biases, in rad/s. Rotation about the vertical is not observable, so it drifts. An acceleration
    whose square differs from gravity's by more than half, as in an impact or a fall, is ignored.

    Attributes:
        sensors: Names of the IMUs.
        estimates: A column for each IMU: quaternion, rates without their bias, bias, last rates,
            and with `compute_rpy` roll, pitch and yaw; shape (13 or 16, IMUs).
    """

    memory: ClassVar[tuple[str, ...]] = ("estimates", "_is_first")

    def __init__(
        self,
        name: str,
        env: PipelineEnv,
        *,
        update_ratio: int = 1,
        kp: float = 1.0,
        ki: float = 0.1,
        exact_init: bool = True,
        ignore_twist: bool = False,
        compute_rpy: bool = False,
    ) -> None:
        """Observe all IMUs of an environment.

        Args:
            name: Name within the pipeline.
            env: The environment below.
            update_ratio: See `Block`.
            kp: How fast the attitude follows the acceleration, in rad/s.
            ki: How fast the bias follows it, in rad/s².
            exact_init: Whether an episode begins with the IMU's true orientation; otherwise with
                the attitude for which its acceleration points up, not rotated about the vertical.
            ignore_twist: Whether to remove all rotation about the vertical.
            compute_rpy: Whether ``roll_pitch_yaw`` is a feature.

        Raises:
            ConfigError: If there is no IMU, or a gain is negative.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        where = f'MahonyFilter "{name}": '
        self.kp = checks.not_negative(f"{where}kp", kp)
        self.ki = checks.not_negative(f"{where}ki", ki)
        self.exact_init, self.ignore_twist = exact_init, ignore_twist
        self.compute_rpy = compute_rpy
        self.refresh_connection()

    def connect(self) -> None:
        """Find the IMUs.

        Raises:
            ConfigError: If there are none.
        """
        simulator = self.env.simulator
        self.sensors = tuple(each.name for each in simulator.sensors if type(each) is Imu)
        if not self.sensors:
            raise ConfigError(
                f'MahonyFilter "{self.name}": the simulator has no Imu. Add one to its sensors.'
            )
        count = len(self.sensors)
        self._measured: Vector = simulator.sensed["Imu"]
        self._moving = self._measured[4:] if count > 1 else self._measured[4:, 0]
        self.estimates = np.zeros((16 if self.compute_rpy else 13, count))
        self._filtered = self.estimates[:13] if count > 1 else self.estimates[:13, 0]
        self._biases, self._is_first = self.estimates[7:10], True
        places = {"orientation": slice(0, 4), "angular_velocity": slice(4, 7)}
        if self.compute_rpy:
            places["roll_pitch_yaw"] = slice(13, 16)
        self.observation = {key: self.estimates[place] for key, place in places.items()}
        self.observation_space = attitude_space(count, has_rpy=self.compute_rpy)
        self.observation["orientation"][3] = 1.0

    def setup(self) -> None:
        """Compute the coefficients for the period."""
        super().setup()
        gravity = math.hypot(*self.env.simulator.world.gravity)
        self._gains = Gains.of(self.kp, self.ki, self.period, gravity)

    def begin(self) -> None:
        """Begin with attitudes from the IMUs, without bias."""
        for column, measured in zip(self.estimates.T, self._measured.T, strict=True):
            column[:4] = (
                measured[:4] if self.exact_init else attitude_from_gravity(*measured[7:].tolist())
            )
            column[4:7] = column[10:13] = measured[4:7]
            column[7:10] = 0.0
        self._is_first = True
        self._complete()

    @property
    def fieldnames(self) -> dict[str, list[list[str]]]:
        """Names of the features' numbers."""
        return attitude_fieldnames(self.sensors, has_rpy=self.compute_rpy)

    @property
    def state_space(self) -> spaces.Box:
        """Space of the biases."""
        return spaces.Box(-np.inf, np.inf, (3, len(self.sensors)), np.float64)

    def get_state(self) -> Vector:
        """Return the biases of the rates, shape (3, IMUs), in rad/s."""
        return self._biases

    @property
    def state_fieldnames(self) -> list[list[str]]:
        """Names of the biases."""
        return [[f"bias.{sensor}.{axis}" for sensor in self.sensors] for axis in "xyz"]

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the attitudes."""
        state: Any = self._filtered
        if self._is_first:  # `begin` has already used this measurement
            self._is_first = False
            return
        if state.ndim == 1:
            measured = self._moving.tolist()
            found = advance(state.tolist(), measured, self._gains)
            _STATE.pack_into(state, 0, *found)
        else:
            state.T[:] = advance_rows(state.T, self._moving.T, self._gains)
        if self.ignore_twist or self.compute_rpy:
            self._complete()

    def _complete(self) -> None:
        """Remove rotation about the vertical, and compute roll, pitch and yaw."""
        for column in self.estimates.T:
            attitude = column[:4].tolist()
            if self.ignore_twist:
                attitude = column[:4] = remove_twist(*attitude)
            if self.compute_rpy:
                column[13:] = to_roll_pitch_yaw(attitude)
