"""How links are turned, from the attitudes of IMUs and the angles of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_core.rotations import invert, multiply, rotate_back, to_roll_pitch_yaw
from physx_core.simulation import Imu
from physx_gym.blocks.block import ObserverBlock
from physx_gym.blocks.mahony_filter import MahonyFilter
from physx_gym.blocks.motor_joints import JointEncoders
from physx_gym.blocks.turning import Turning

if TYPE_CHECKING:
    from physx_gym.env.layers.layer import PipelineEnv


class BodyObserver(ObserverBlock):
    """Estimates how links are turned, from a `MahonyFilter` below and the encoders of joints.

    Each link takes the IMU with the fewest joints between them; these joints need encoders. Its
    features, each with a column for each link: ``orientation``, quaternions x, y, z, w in the
    world; ``angular_velocity`` in rad/s along the link's own axes; with `compute_rpy` also
    ``roll_pitch_yaw``, in rad.

    Attributes:
        bodies: Names of the links.
        compute_rpy: Whether ``roll_pitch_yaw`` is a feature.
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
            env: The environment below, with a `MahonyFilter` somewhere.
            update_ratio: See `Block`.
            bodies: Names of the links; None: those with an IMU.
            compute_rpy: See above.

        Raises:
            ConfigError: There is no `MahonyFilter`, or a joint has no encoder.
            SimulationError: There is no link of a name.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        self._wanted = None if bodies is None else tuple(bodies)
        self.compute_rpy = compute_rpy
        self.refresh_connection()

    def connect(self) -> None:
        """Find IMUs and encoders."""
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
        self._ways: list[tuple[int, Turning, list[int]]] = []
        joints: dict[str, int] = {}
        for body in self.bodies:
            ways = [Turning(simulator.simulation, imu.body, body) for imu in imus]
            place = min(range(len(ways)), key=lambda i: len(ways[i].joints))
            for name in ways[place].joints:
                joints.setdefault(name, len(joints))
            columns = [joints[name] for name in ways[place].joints]
            self._ways.append((place, ways[place], columns))
        self._encoders = JointEncoders(self.env, list(joints), where) if joints else None
        self._make_buffers(len(self.bodies))

    def _make_buffers(self, count: int) -> None:
        boxes: dict[str, spaces.Space[Any]] = {
            "orientation": spaces.Box(-1.01, 1.01, (4, count), np.float64),
            "angular_velocity": spaces.Box(-np.inf, np.inf, (3, count), np.float64),
        }
        if self.compute_rpy:
            boxes["roll_pitch_yaw"] = spaces.Box(-np.inf, np.inf, (3, count), np.float64)
        self._observe_in(spaces.Dict(boxes))
        self.observation["orientation"][3] = 1.0

    @property
    def fieldnames(self) -> dict[str, list[list[str]]]:
        """Names of the features' numbers."""
        axes = {"orientation": "xyzw", "angular_velocity": "xyz"}
        names = {key: [[f"{key}.{b}.{a}" for b in self.bodies] for a in axes[key]] for key in axes}
        if self.compute_rpy:
            angles = ("roll", "pitch", "yaw")
            names["roll_pitch_yaw"] = [[f"{a}.{b}" for b in self.bodies] for a in angles]
        return names

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Bring the links' attitudes to the present."""
        angles: list[float] = []
        rates: list[float] = []
        if self._encoders is not None:
            self._encoders.refresh()
            angles, rates = self._encoders.values.tolist()
        seen = self._filter.observation
        attitudes = seen["orientation"].T.tolist()
        turns = seen["angular_velocity"].T.tolist()
        found = []
        for place, way, columns in self._ways:
            offset = self._offsets[place]
            body, rate = way.carry(
                multiply(attitudes[place], offset),
                rotate_back(offset, *turns[place]),
                [angles[column] for column in columns],
                [rates[column] for column in columns],
            )
            found.append((body, rate))
        self.observation["orientation"].T[:] = [body for body, _ in found]
        self.observation["angular_velocity"].T[:] = [rate for _, rate in found]
        if self.compute_rpy:
            self.observation["roll_pitch_yaw"].T[:] = [to_roll_pitch_yaw(body) for body, _ in found]
