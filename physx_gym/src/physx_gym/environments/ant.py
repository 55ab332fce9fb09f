"""Ant: a four-legged robot that learns to walk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core import checks
from physx_core.typing import Vector
from physx_gym.defaults import BACKEND
from physx_gym.env.pipeline_env import Info
from physx_gym.env.robot_env import RobotEnv
from physx_gym.environments import limits
from physx_gym.simulator.simulator import Simulator
from physx_sim import Ground, Robot, World

FARTHEST = 1000.0


class AntEnv(RobotEnv):
    """Walk along the x axis on four two-joint legs: ``physx/Ant-v0``.

    Action, shape (8,): torques of the joints, as fractions of 60 N m. Observation, shape (27,):
    height of the torso in m; its orientation, a quaternion x, y, z, w; the joints' positions in
    rad; velocity of the torso in its own frame, in m/s and rad/s; the joints' velocities. Reward:
    mean velocity along x in the step, in m/s, plus 0.5 while the ant is healthy, minus 0.005 times
    the sum of the squared actions; the information has the parts, as ``"reward_forward"`` and so
    on. The ant is healthy while its torso is between 0.1 and 1 m high, and not upside down; the
    torso's radius is 0.2 m, so it may lie on the ground. An episode terminates when the ant is no
    longer healthy, and is truncated after 1000 steps of 50 ms.

    The task is that of J. Schulman et al., "High-dimensional continuous control using generalized
    advantage estimation", 2015, with another robot. Options have the same names as in Gymnasium's
    ``Ant-v5``.
    """

    constants: ClassVar[tuple[str, ...]] = (
        *("_forward_weight", "_effort_weight", "_healthy_reward", "_terminates", "_noise"),
        *("_lowest", "_highest", "_first_seen", "_strength", "_place", "_before"),
    )

    def __init__(
        self,
        *,
        backend: Any = BACKEND,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.005,
        healthy_reward: float = 0.5,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.1, 1.0),
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        **options: Any,
    ) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine.
            forward_reward_weight: Weight of the velocity along x.
            ctrl_cost_weight: Weight of the sum of the squared actions.
            healthy_reward: Reward for a step after which the ant is healthy.
            terminate_when_unhealthy: Whether an episode terminates when the ant is not healthy.
            healthy_z_range: Heights of the torso between which the ant is healthy, in m.
            reset_noise_scale: Half the range from which the joints' initial positions are drawn, in
                rad, and standard deviation of the initial velocities, in m/s and rad/s.
            exclude_current_positions_from_observation: Whether the observation leaves out x and y
                of the torso, which otherwise come first.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.

        Raises:
            ConfigError: If an option is invalid.
        """
        self._forward_weight = checks.finite("forward_reward_weight", forward_reward_weight)
        self._effort_weight = checks.finite("ctrl_cost_weight", ctrl_cost_weight)
        self._healthy_reward = checks.finite("healthy_reward", healthy_reward)
        self._terminates = bool(terminate_when_unhealthy)
        self._lowest, self._highest = checks.vector("healthy_z_range", healthy_z_range, 2)
        self._noise = checks.not_negative("reset_noise_scale", reset_noise_scale)
        self._first_seen = 2 if exclude_current_positions_from_observation else 0
        world = World(
            [Robot("ant", fixed_base=False)], period=1.25e-2, iterations=5, ground=Ground()
        )
        options = {"simulation_duration_max": 50.0, **options}
        super().__init__(Simulator(world, backend=backend, sensors=()), 0.05, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (8,))
        self._strength = self.simulator.max_commands()

    def _initialize_observation_space(self) -> None:
        simulator = self.simulator
        self.observation_space = limits.box(
            np.full(3 - self._first_seen, FARTHEST),
            np.full(4, 1.001),
            limits.joint_positions(simulator),
            np.full(6, limits.FASTEST),
            limits.joint_velocities(simulator),
        )

    def _sample_state(self) -> tuple[Vector, Vector]:
        positions = self._neutral()
        middle = 0.5 * (self.simulator.layout.lower + self.simulator.layout.upper)
        positions[7:] = middle + self._noise * self.np_random.uniform(-1.0, 1.0, 8)
        velocities = self._noise * self.np_random.normal(size=14)
        return self.simulator.place_on_ground(positions), velocities

    def _initialize_buffers(self) -> None:
        self._place = self._before = self.robot_state.q[:2].tolist()

    def _refresh_buffers(self) -> None:
        self._before, self._place = self._place, self.robot_state.q[:2].tolist()

    def _memory(self) -> Any:
        return self._place, self._before

    def _recall(self, memory: Any) -> None:
        self._place, self._before = memory

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe the state, without the position on the ground unless requested."""
        state = measurement["states"]["agent"]
        self.observation[:-14], self.observation[-14:] = state["q"][self._first_seen :], state["v"]

    def compute_command(self, action: Any, command: Vector) -> None:
        """Scale the action to torques."""
        np.multiply(action, self._strength, out=command)

    @property
    def is_healthy(self) -> bool:
        """Whether the torso is neither too low, nor too high, nor upside down."""
        height, x, y, _, _ = self.observation[2 - self._first_seen :][:5].tolist()
        upright = 1.0 - 2.0 * (x * x + y * y) > 0.0
        return bool(upright and self._lowest <= height <= self._highest)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the ant is no longer healthy."""
        return self._terminates and not self.is_healthy, not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward for walking."""
        (x, y), (x_before, y_before) = self._place, self._before
        velocity = (x - x_before) / self.step_dt
        parts = {
            "reward_forward": self._forward_weight * velocity,
            "reward_survival": self._healthy_reward if self.is_healthy else 0.0,
            "reward_effort": -self._effort_weight * float(self.action @ self.action),
        }
        info |= parts
        info["x_position"], info["y_position"] = x, y
        info["x_velocity"], info["y_velocity"] = velocity, (y - y_before) / self.step_dt
        return float(sum(parts.values()))
