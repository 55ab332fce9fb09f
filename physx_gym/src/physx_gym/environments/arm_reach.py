"""An arm that reaches for random points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core.components import Factory
from physx_core.typing import Vector
from physx_gym.defaults import BACKEND
from physx_gym.env.pipeline_env import Info
from physx_gym.environments import limits
from physx_gym.environments.goal import GoalEnv, GoalTask
from physx_gym.simulator.simulator import Simulator
from physx_sim import JointSettings, Mimic, Motor, Robot, World

HAND = "panda_hand"
SPEED = 1.5
STIFFNESS = np.array([400.0, 400.0, 400.0, 400.0, 100.0, 100.0, 50.0])
DAMPING = np.array([40.0, 40.0, 40.0, 40.0, 8.0, 8.0, 4.0])
_ARM = [f"panda_joint{number}" for number in range(1, 8)]
_REST = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.0])


class ArmReachEnv(GoalTask):
    """Reach for a point with the hand of a Franka Panda: ``physx/ArmReach-v0``.

    Requires the robots of ``physx-dart[robots]``. Action, shape (7,): velocities of the joints, as
    fractions of 1.5 rad/s; a controller follows them and compensates gravity. Observation, shape
    (20,): positions and velocities of the joints, in rad and rad/s; position of the hand, and
    vector from there to the point, in m. Reward: minus the distance in m, minus a hundredth of the
    mean squared action; ``info["is_success"]`` is whether the distance is below 5 cm. An episode
    never terminates and is truncated after 100 steps of 40 ms.
    """

    ACHIEVED, CLOSE = slice(14, 17), 0.05

    constants: ClassVar[tuple[str, ...]] = ("goal", "_still", "_lower", "_upper", "_target")

    def __init__(self, *, backend: Any = BACKEND, **options: Any) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        fingers = JointSettings(stiffness=1e3, damping=50.0, mimic=Mimic(""))  # held, and faster
        # The engine damps at every physics step: the wrist is too light for the controller's rate.
        pairs = zip(_ARM, DAMPING.tolist(), strict=True)
        damped = {joint: JointSettings(damping=damping) for joint, damping in pairs}
        robot = Robot(
            "panda/panda_collision",
            collisions="none",
            joints={"panda_finger_joint1": fingers, "panda_finger_joint2": fingers, **damped},
        )
        self.goal = np.zeros(3)
        simulator = Simulator(
            World([robot], period=2e-3),
            backend=backend,
            motors=[Motor(joint=joint) for joint in _ARM],
            sensors=(),
            control_period=0.01,
        )
        options = {"simulation_duration_max": 4.0, **options}
        super().__init__(simulator, 0.04, **options)
        self._still = np.zeros(simulator.layout.nv)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (7,))
        layout = self.simulator.layout
        self._lower, self._upper = layout.lower[:7].copy(), layout.upper[:7].copy()
        self._target = _REST.copy()

    def _initialize_observation_space(self) -> None:
        simulator = self.simulator
        positions, velocities = (
            limits.joint_positions(simulator),
            limits.joint_velocities(simulator),
        )
        self.observation_space = limits.box(positions[:7], velocities[:7], np.full(6, 3.0))

    def _sample_state(self) -> tuple[Vector, Vector]:
        positions = self._neutral()
        reached = positions.copy()
        away = self.np_random.uniform(-0.8, 0.8, 7)
        reached[:7] = np.clip(_REST + away, self._lower, self._upper)
        self.goal[:] = self.simulator.simulation.body_poses([HAND], reached)[0, :3]
        positions[:7] = _REST + self.np_random.uniform(-0.1, 0.1, 7)
        self._target[:] = positions[:7]
        return positions, np.zeros(len(self.robot_state.v))

    def _memory(self) -> Any:
        return {"goal": self.goal.copy(), "target": self._target.copy()}

    def _recall(self, memory: Any) -> None:
        self.goal[:], self._target[:] = memory["goal"], memory["target"]

    def _draw(self, scene: Factory) -> None:
        scene.add_sphere("goal", self.CLOSE, position=self.goal, color="limegreen")

    def _redraw(self, scene: Factory) -> None:
        scene.update_sphere("goal", position=self.goal)

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe the joints, the hand and the point."""
        state, seen = measurement["states"]["agent"], self._seen
        seen[:7], seen[7:14] = state["q"][:7], state["v"][:7]
        hand = self.simulator.simulation.body_poses([HAND])[0, :3]
        seen[14:17], seen[17:] = hand, self.goal - hand

    def compute_command(self, action: Any, command: Vector) -> None:
        """Follow the velocities, and compensate gravity."""
        self._target += SPEED * self.control_dt * action
        np.clip(self._target, self._lower, self._upper, out=self._target)
        state, simulation = self.robot_state, self.simulator.simulation
        weight = simulation.inverse_dynamics(state.q, self._still, self._still)[:7]
        np.subtract(self._target, state.q[:7], out=command)
        command *= STIFFNESS
        command += SPEED * DAMPING * action
        command += weight

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return no termination: the hand must stay at the point."""
        return False, not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward for being close to the point."""
        away = self._seen[17:]
        distance = float(np.sqrt(away @ away))
        info["is_success"] = distance < self.CLOSE
        return -distance - 0.01 * float(self.action @ self.action) / 7


class ArmReachGoalEnv(GoalEnv, ArmReachEnv):
    """`ArmReachEnv` with goals that hindsight can replace: ``physx/ArmReachGoal-v0``.

    Observation: a dictionary of ``"observation"``, shape (17,): positions and velocities of the
    joints, in rad and rad/s, and position of the hand, in m; ``"achieved_goal"``, shape (3,): the
    hand's position again; and ``"desired_goal"``, shape (3,): the point. Reward: see `GoalEnv`.
    """
