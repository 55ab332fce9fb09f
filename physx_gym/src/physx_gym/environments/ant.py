"""Ant: a four-legged robot that learns to run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.simulation import Ground, Robot, World
from physx_core.typing import Vector
from physx_gym.defaults import BACKEND
from physx_gym.env.pipeline_env import Info
from physx_gym.env.robot_env import RobotEnv
from physx_gym.environments import limits
from physx_gym.simulator.simulator import Simulator

LOWEST, HIGHEST = 0.12, 1.0
FARTHEST = 1000.0


class AntEnv(RobotEnv):
    """Run along the x axis on four legs of two joints: ``physx/Ant-v0``.

    Action, shape (8,): torques of the joints, as fractions of 15 N m. Observation, shape (27,):
    height of the torso in m; its orientation, a quaternion x, y, z, w; the joints' positions in
    rad; velocity of the torso in its own frame, in m/s and rad/s; the joints' velocities. Reward:
    mean velocity along x in the step, in m/s, plus 1, minus half the sum of the squared actions;
    ``info["reward"]`` has the parts. It terminates if the torso is below 0.12 m, above 1 m, or
    upside down, and is truncated after 1000 steps of 50 ms.

    The task is that of J. Schulman et al., "High-dimensional continuous control using generalized
    advantage estimation", 2015, with another robot.
    """

    def __init__(self, *, backend: Any = BACKEND, **options: Any) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        world = World([Robot("ant", fixed_base=False)], period=6.25e-3, ground=Ground())
        options = {"simulation_duration_max": 50.0, **options}
        super().__init__(Simulator(world, backend=backend, sensors=()), 0.05, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (8,))
        self._strength = self.simulator.max_commands()

    def _initialize_observation_space(self) -> None:
        simulator = self.simulator
        self.observation_space = limits.box(
            [FARTHEST],
            np.full(4, 1.001),
            limits.joint_positions(simulator),
            np.full(6, limits.FASTEST),
            limits.joint_velocities(simulator),
        )

    def _sample_state(self) -> tuple[Vector, Vector]:
        positions = self._neutral()
        middle = 0.5 * (self.simulator.layout.lower + self.simulator.layout.upper)
        positions[7:] = middle + self.np_random.uniform(-0.1, 0.1, 8)
        return self.simulator.place_on_ground(positions), self.np_random.normal(0.0, 0.05, 14)

    def _initialize_buffers(self) -> None:
        self._place = self._before = float(self.robot_state.q[0])

    def _refresh_buffers(self) -> None:
        self._before, self._place = self._place, float(self.robot_state.q[0])

    def _memory(self) -> Any:
        return self._place, self._before

    def _recall(self, memory: Any) -> None:
        self._place, self._before = memory

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe the whole state except the position on the ground."""
        state = measurement["states"]["agent"]
        self.observation[:13], self.observation[13:] = state["q"][2:], state["v"]

    def compute_command(self, action: Any, command: Vector) -> None:
        """Scale the action to torques."""
        np.multiply(action, self._strength, out=command)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the torso is too low, too high, or upside down."""
        height, x, y, _, _ = self.observation[:5].tolist()
        upright = 1.0 - 2.0 * (x * x + y * y) > 0.0
        return not (LOWEST < height < HIGHEST and upright), not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward for running."""
        forward = (self._place - self._before) / self.step_dt
        effort = -0.5 * float(self.action @ self.action)
        info["reward"] = {"forward": forward, "survival": 1.0, "effort": effort}
        return forward + 1.0 + effort
