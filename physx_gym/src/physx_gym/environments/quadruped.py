"""A quadruped that learns to walk."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core.rotations import rotate_back_rows
from physx_core.typing import Vector
from physx_gym.defaults import BACKEND
from physx_gym.env.pipeline_env import Info
from physx_gym.env.robot_env import RobotEnv
from physx_gym.environments import limits
from physx_gym.simulator.simulator import Simulator
from physx_sim import Ground, Robot, World

STAND = {"hip": 0.0, "thigh": 0.8, "calf": -1.6}
RANGE = 0.4
STIFFNESS, DAMPING = 40.0, 1.0
LOWEST, STEEPEST = 0.12, math.cos(1.0)
_UP = np.array([[0.0, 0.0, 1.0]])


class QuadrupedEnv(RobotEnv):
    """Walk along the x axis with a Unitree A1: ``physx/Quadruped-v0``.

    Requires the robots of ``physx-dart[robots]``. Action, shape (12,): target positions of the
    joints, as fractions of 0.4 rad from a standing pose; a controller with gains of 40 N m/rad and
    1 N m s/rad follows them, 200 times a second. Observation, shape (47,): the vertical in the
    frame of the trunk; linear and angular velocity of the trunk in its frame, in m/s and rad/s; the
    joints' positions relative to the standing pose, in rad, and velocities; the last action; cosine
    and sine of the heading, the angle from the x axis to the trunk's. Reward: up to 2 for a forward
    velocity of `speed`, up to 0.5 for going straight, up to 0.5 for a heading of 0, 0.25 for
    staying up, minus costs of torques and abrupt actions; the information has the parts, as
    ``"reward_forward"`` and so on, ``info["x_velocity"]`` the mean velocity along the x axis in the
    step, in m/s. An episode terminates if the trunk is below 0.12 m or leans by more than 1 rad,
    and is truncated after 1000 steps of 20 ms.
    """

    constants: ClassVar[tuple[str, ...]] = (
        "speed",
        "_stand",
        "_previous",
        "_haste",
        "_place",
        "_before",
    )

    def __init__(self, *, backend: Any = BACKEND, speed: float = 0.6, **options: Any) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine.
            speed: Desired forward velocity, in m/s.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        self.speed = float(speed)
        world = World([Robot("a1/a1", fixed_base=False)], period=5e-3, ground=Ground())
        simulator = Simulator(world, backend=backend, sensors=(), control_period=5e-3)
        options = {"simulation_duration_max": 20.0, **options}
        super().__init__(simulator, 0.02, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (12,))
        joints = self.simulator.layout.joints
        parts = [next(part for part in STAND if part in joint) for joint in joints]
        self._stand = np.array([STAND[part] for part in parts])
        self._previous = np.zeros(12)

    def _initialize_observation_space(self) -> None:
        simulator = self.simulator
        self.observation_space = limits.box(
            np.full(3, 1.001),
            np.full(6, limits.FASTEST),
            limits.joint_positions(simulator) + np.abs(self._stand),
            limits.joint_velocities(simulator),
            np.ones(12),
            np.full(2, 1.001),
        )

    def _sample_state(self) -> tuple[Vector, Vector]:
        positions = self._neutral()
        positions[7:] = self._stand + self.np_random.uniform(-0.05, 0.05, 12)
        return self.simulator.place_on_ground(positions), np.zeros(18)

    def _initialize_buffers(self) -> None:
        self._previous[:] = 0.0
        self._haste = 0.0
        self._place = self._before = float(self.robot_state.q[0])

    def _refresh_buffers(self) -> None:
        change = self.action - self._previous
        self._haste = float(change @ change)
        self._previous[:] = self.action
        self._before, self._place = self._place, float(self.robot_state.q[0])

    def _memory(self) -> Any:
        places = self._place, self._before
        return {"previous": self._previous.copy(), "haste": self._haste, "places": places}

    def _recall(self, memory: Any) -> None:
        self._previous[:], self._haste = memory["previous"], memory["haste"]
        self._place, self._before = memory["places"]

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe attitude, velocities, joints, the last action and the heading."""
        state, seen = measurement["states"]["agent"], self.observation
        q, v = state["q"], state["v"]
        seen[:3] = rotate_back_rows(q[np.newaxis, 3:7], _UP)[0]
        seen[3:9] = v[:6]
        np.subtract(q[7:], self._stand, out=seen[9:21])
        seen[21:33], seen[33:45] = v[6:], self._previous
        x, y, z, w = q[3:7].tolist()
        cos, sin = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
        length = math.hypot(cos, sin) or 1.0
        seen[45], seen[46] = cos / length, sin / length

    def compute_command(self, action: Any, command: Vector) -> None:
        """Drive the joints to their target positions."""
        state = self.robot_state
        np.multiply(action, RANGE, out=command)
        command += self._stand
        command -= state.q[7:]
        command *= STIFFNESS
        command -= DAMPING * state.v[6:]

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the robot has fallen."""
        low = self.robot_state.q[2] < LOWEST
        return bool(low or self.observation[2] < STEEPEST), not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward for walking."""
        forward, left, _, _, _, turn = self.observation[3:9].tolist()
        heading = math.atan2(self.observation[46], self.observation[45])
        torques = self.robot_state.command
        parts = {
            "reward_forward": 2.0 * math.exp(-4.0 * (forward - self.speed) ** 2),
            "reward_straight": 0.5 * math.exp(-4.0 * (left**2 + 0.25 * turn**2)),
            "reward_heading": 0.5 * math.exp(-4.0 * heading**2),
            "reward_survival": 0.0 if terminated else 0.25,
            "reward_torques": -1e-4 * float(torques @ torques),
            "reward_haste": -0.01 * self._haste,
        }
        info |= parts
        info["x_velocity"] = (self._place - self._before) / self.step_dt
        return sum(parts.values())
