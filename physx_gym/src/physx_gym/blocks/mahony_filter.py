"""Attitudes of IMUs from what they measure."""

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
from physx_core.simulation import Imu
from physx_core.typing import Vector
from physx_gym.blocks.block import ObserverBlock
from physx_gym.blocks.mahony import (
    Gains,
    advanced,
    advanced_rows,
    upright,
    without_twist,
)

if TYPE_CHECKING:
    from physx_gym.env.layers.layer import PipelineEnv


_STATE = struct.Struct("13d")
"""A quicker way to write plain numbers into an array."""


class MahonyFilter(ObserverBlock):
    """Estimates how IMUs are turned, from the rates and accelerations that they measure.

    Its features, each with a column for each IMU: ``orientation``, quaternions x, y, z, w of the
    sensors in the world; ``angular_velocity``, their rates less the estimated bias, in rad/s, along
    the sensors' axes; with `compute_rpy` also ``roll_pitch_yaw``, in rad. Its state: the estimated
    biases of the rates, in rad/s. The turn about the vertical cannot be seen and drifts. An
    acceleration whose square is more than half off that of gravity, as in an impact or a fall, is
    not trusted.

    Attributes:
        sensors: Names of the IMUs.
        kp: How fast the attitude follows the acceleration, in rad/s.
        ki: How fast the bias follows it, in rad/s².
        exact_init: Whether an episode begins with the IMU's own orientation; otherwise with the
            attitude at which its acceleration points up, without any turn about the vertical.
        ignore_twist: Whether to leave out all turns about the vertical.
        compute_rpy: Whether ``roll_pitch_yaw`` is a feature.
        estimates: A column for each IMU: quaternion, rates less their bias, bias, last rates, and
            with `compute_rpy` roll, pitch and yaw; shape (13 or 16, IMUs).
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
            kp: See above.
            ki: See above.
            exact_init: See above.
            ignore_twist: See above.
            compute_rpy: See above.

        Raises:
            ConfigError: There is no IMU, or a gain is negative.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        where = f'MahonyFilter "{name}": '
        self.kp = checks.not_negative(f"{where}kp", kp)
        self.ki = checks.not_negative(f"{where}ki", ki)
        self.exact_init, self.ignore_twist = exact_init, ignore_twist
        self.compute_rpy = compute_rpy
        self.refresh_connection()

    def connect(self) -> None:
        """Find the IMUs."""
        simulator = self.env.simulator
        self.sensors = tuple(each.name for each in simulator.sensors if type(each) is Imu)
        if not self.sensors:
            raise ConfigError(
                f'MahonyFilter "{self.name}": the simulator has no Imu. Give one to its sensors.'
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
        self.observation_space = spaces.Dict(
            {
                key: spaces.Box(-most, most, part.shape, np.float64)
                for key, part in self.observation.items()
                for most in (1.01 if key == "orientation" else np.inf,)
            }
        )
        self.observation["orientation"][3] = 1.0

    def setup(self) -> None:
        """Take up the period."""
        super().setup()
        gravity = math.hypot(*self.env.simulator.world.gravity)
        self._gains = Gains.of(self.kp, self.ki, self.period, gravity)

    def begin(self) -> None:
        """Begin with the attitudes that the IMUs say, without bias."""
        for column, measured in zip(self.estimates.T, self._measured.T, strict=True):
            column[:4] = measured[:4] if self.exact_init else upright(*measured[7:].tolist())
            column[4:7] = column[10:13] = measured[4:7]
            column[7:10] = 0.0
        self._is_first = True
        self._complete()

    @property
    def fieldnames(self) -> dict[str, list[list[str]]]:
        """Names of the features' numbers."""
        axes = {"orientation": "xyzw", "angular_velocity": "xyz"}
        names = {key: [[f"{key}.{s}.{a}" for s in self.sensors] for a in axes[key]] for key in axes}
        if self.compute_rpy:
            angles = ("roll", "pitch", "yaw")
            names["roll_pitch_yaw"] = [[f"{a}.{s}" for s in self.sensors] for a in angles]
        return names

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
        """Bring the attitudes to the present."""
        state: Any = self._filtered
        if self._is_first:  # it has seen this measurement when it began
            self._is_first = False
            return
        if state.ndim == 1:
            measured = self._moving.tolist()
            found = advanced(state.tolist(), measured, self._gains)
            _STATE.pack_into(state, 0, *found)
        else:
            state.T[:] = advanced_rows(state.T, self._moving.T, self._gains)
        if self.ignore_twist or self.compute_rpy:
            self._complete()

    def _complete(self) -> None:
        """Leave out turns about the vertical, and work out roll, pitch and yaw."""
        for column in self.estimates.T:
            attitude = column[:4].tolist()
            if self.ignore_twist:
                attitude = column[:4] = without_twist(*attitude)
            if self.compute_rpy:
                column[13:] = to_roll_pitch_yaw(attitude)
