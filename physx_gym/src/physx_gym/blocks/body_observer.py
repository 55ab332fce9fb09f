"""Estimates the orientations of links from the attitudes of IMUs and the angles of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from physx_core.errors import ConfigError
from physx_core.rotations import invert, multiply, rotate_back, to_roll_pitch_yaw
from physx_gym.blocks.attitude_features import attitude_fieldnames, attitude_space
from physx_gym.blocks.block import ObserverBlock
from physx_gym.blocks.mahony_filter import MahonyFilter
from physx_gym.blocks.motor_joints import JointEncoders
from physx_gym.blocks.relative_orientation import RelativeOrientation
from physx_sim import Imu

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class BodyObserver(ObserverBlock):
    """Estimates the orientations of links from a `MahonyFilter` below and joint encoders.

    For each link, it uses the IMU with the fewest joints in between; these joints need encoders.
    Its features have a column for each link: ``orientation``, quaternions x, y, z, w in the world;
    ``angular_velocity``, in rad/s along the link's own axes; with `compute_rpy`, also
    ``roll_pitch_yaw``, in rad.

    Attributes:
        bodies: Names of the links.
    """

    def __init__(
        self,
        name: str,
        env: PipelineEnv,
        *,
        update_ratio: int = 1,
        bodies: Sequence[str] | None = None,
        compute_rpy: bool = False,
    ) -> None:
        """Observe links of an environment.

        Args:
            name: Name within the pipeline.
            env: The environment below, which includes a `MahonyFilter`.
            update_ratio: See `Block`.
            bodies: Names of the links; None: those with an IMU.
            compute_rpy: Whether ``roll_pitch_yaw`` is a feature.

        Raises:
            ConfigError: If there is no `MahonyFilter` below, or a joint does not have an encoder.
            SimulationError: If there is no link of that name.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        self._wanted = None if bodies is None else tuple(bodies)
        self.compute_rpy = compute_rpy
        self.refresh_connection()

    def connect(self) -> None:
        """Find IMUs and encoders.

        Raises:
            ConfigError: If there is no `MahonyFilter` below, or a needed encoder is missing.
        """
        where = f'BodyObserver "{self.name}"'
        found = [getattr(layer, "block", None) for layer in self.env.layers]
        filters = [each for each in found if isinstance(each, MahonyFilter)]
        if not filters:
            raise ConfigError(f"{where} needs a MahonyFilter in an ObservedEnv below.")
        self._filter = filters[-1]
        simulator = self.env.simulator
        imus = [each for each in simulator.sensors if type(each) is Imu]
        self.bodies = self._wanted or tuple(dict.fromkeys(imu.body for imu in imus))
        self._offsets = [invert(imu.rotation) for imu in imus]
        self._paths: list[tuple[int, RelativeOrientation, list[int]]] = []
        joints: dict[str, int] = {}
        for body in self.bodies:
            paths = [RelativeOrientation(simulator.simulation, imu.body, body) for imu in imus]
            place = min(range(len(paths)), key=lambda i: len(paths[i].joints))
            for name in paths[place].joints:
                joints.setdefault(name, len(joints))
            columns = [joints[name] for name in paths[place].joints]
            self._paths.append((place, paths[place], columns))
        self._encoders = JointEncoders(self.env, list(joints), where) if joints else None
        self._set_observation_space(attitude_space(len(self.bodies), has_rpy=self.compute_rpy))
        self.observation["orientation"][3] = 1.0

    @property
    def fieldnames(self) -> dict[str, list[list[str]]]:
        """Names of the features' numbers."""
        return attitude_fieldnames(self.bodies, has_rpy=self.compute_rpy)

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the orientations of the links."""
        angles: list[float] = []
        rates: list[float] = []
        if self._encoders is not None:
            self._encoders.refresh()
            angles, rates = self._encoders.values.tolist()
        seen = self._filter.observation
        attitudes = seen["orientation"].T.tolist()
        velocities = seen["angular_velocity"].T.tolist()
        found = []
        for place, path, columns in self._paths:
            offset = self._offsets[place]
            body, rate = path.transfer(
                multiply(attitudes[place], offset),
                rotate_back(offset, *velocities[place]),
                [angles[column] for column in columns],
                [rates[column] for column in columns],
            )
            found.append((body, rate))
        self.observation["orientation"].T[:] = [body for body, _ in found]
        self.observation["angular_velocity"].T[:] = [rate for _, rate in found]
        if self.compute_rpy:
            self.observation["roll_pitch_yaw"].T[:] = [to_roll_pitch_yaw(body) for body, _ in found]
