"""A gantry that pushes a box to a goal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from physx_sim import Box, Ground, JointSettings, Motor, Robot, World

FORCE = 20.0
REACH = 1.0
SIZE = (0.25, 0.25, 0.2)
BEHIND = 0.18


class PushBoxEnv(GoalTask):
    """Push a box of 0.5 kg over the ground to a goal: ``physx/PushBox-v0``.

    The robot is a gantry that moves a stick over the ground. It needs an engine with contacts
    between moving bodies. Action, shape (2,): forces along x and y, as fractions of 20 N.
    Observation, shape (15,): position and velocity of the stick; position of the box, cosine and
    sine of its heading, its linear and angular velocity; vectors from the stick to the box and from
    the box to the goal; in m, m/s and rad/s. Reward: minus the box's distance from the goal, minus
    a quarter of the stick's distance from the point 18 cm behind the box's center, from which it
    pushes the box toward the goal, in m; plus 10 when the box is within 8 cm of the goal, which
    terminates the episode. It is truncated after 200 steps of 50 ms, or if the box is out of reach.
    """

    ACHIEVED, CLOSE = slice(4, 6), 0.08
    view: ClassVar[Mapping[str, Sequence[float]]] = {
        "eye": (0.7, -1.2, 0.8),
        "target": (0.0, 0.0, 0.1),
    }

    constants: ClassVar[tuple[str, ...]] = ("goal", "_box")

    def __init__(self, *, backend: Any = BACKEND, **options: Any) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine; it needs the feature ``body_contacts``.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        self.goal = np.zeros(2)
        rubs = JointSettings(damping=8.0)
        world = World(
            [Robot("gantry", joints={"gantry_x": rubs, "gantry_y": rubs}, friction=0.3)],
            period=5e-3,
            objects=[Box(name="box", size=SIZE, mass=0.5, friction=0.5, position=(0, 0, 0.1))],
            ground=Ground(friction=0.5),
        )
        motors = [Motor(joint=f"gantry_{axis}", max_torque=FORCE) for axis in "xy"]
        options = {"simulation_duration_max": 10.0, **options}
        simulator = Simulator(world, backend=backend, motors=motors, sensors=())
        super().__init__(simulator, 0.05, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self._box = self.simulator.layout.parts["box"]

    def _initialize_observation_space(self) -> None:
        self.observation_space = limits.box(
            np.full(2, 2.0), np.full(2, 10.0), np.full(2, 4.0), [1.001, 1.001],
            np.full(2, 20.0), [limits.FASTEST], np.full(4, 5.0),
        )  # fmt: skip

    def _sample_state(self) -> tuple[Vector, Vector]:
        draw = self.np_random.uniform
        positions = np.zeros(self.simulator.layout.nq)
        place, heading = draw(-0.4, 0.4, 2), draw(-math.pi, math.pi)
        turn = 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)
        positions[self._box.positions] = *place, SIZE[2] / 2, *turn
        self.goal[:] = _away_from(self.np_random, place, 0.3, 0.6)
        positions[self.robot.positions] = _away_from(self.np_random, place, 0.3, 0.9)
        return positions, np.zeros(self.simulator.layout.nv)

    def _memory(self) -> Any:
        return self.goal.copy()

    def _recall(self, memory: Any) -> None:
        self.goal[:] = memory

    def _draw(self, scene: Factory) -> None:
        scene.add_lines("goal", self._goal_circle(), color="limegreen", size=0.008)

    def _redraw(self, scene: Factory) -> None:
        scene.update_lines("goal", positions=self._goal_circle())

    def _goal_circle(self) -> Vector:
        """Return points on the circle around the goal that the center of the box must be in."""
        angles = np.linspace(0.0, 2 * math.pi, 33)
        around = self.CLOSE * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return np.insert(self.goal + around, 2, 0.01, axis=1)

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe the stick, the box and the goal."""
        state, seen = measurement["states"]["agent"], self._seen
        simulation, part = self.simulator.simulation, self._box
        pose, twist = simulation.positions()[part.positions], simulation.body_velocities(["box"])[0]
        x, y, z, w = pose[3:].tolist()
        seen[:2], seen[2:4] = state["q"], state["v"]
        seen[4:6], seen[6], seen[7] = pose[:2], 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
        seen[8:10], seen[10] = twist[:2], twist[5]
        seen[11:13] = pose[:2] - seen[:2]
        seen[13:15] = self.goal - pose[:2]

    def compute_command(self, action: Any, command: Vector) -> None:
        """Scale the action to forces."""
        np.multiply(action, FORCE, out=command)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the box is at the goal, and whether it is out of reach."""
        box, left = self._seen[4:6], self._seen[13:15]
        info["is_success"] = bool(left @ left < self.CLOSE**2)
        return info["is_success"], bool(np.abs(box).max() > REACH) or not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward for a box close to its goal, and a stick that can push it there."""
        x, y, to_goal_x, to_goal_y = self._seen[11:15].tolist()
        left = math.hypot(to_goal_x, to_goal_y)
        behind = BEHIND / max(left, 1e-9)
        away = math.hypot(x - behind * to_goal_x, y - behind * to_goal_y)
        return (10.0 if terminated else 0.0) - left - 0.25 * away


class PushBoxGoalEnv(GoalEnv, PushBoxEnv):
    """`PushBoxEnv` with goals that hindsight can replace: ``physx/PushBoxGoal-v0``.

    Observation: a dictionary of ``"observation"``, shape (13,): that of `PushBoxEnv` up to the
    vector from the stick to the box; ``"achieved_goal"``, shape (2,): the position of the box, in
    m; and ``"desired_goal"``, shape (2,). Reward: see `GoalEnv`. Episodes do not terminate.
    """


def _away_from(
    random: np.random.Generator, place: Vector, nearest: float, farthest: float
) -> Vector:
    """Return a random point within the gantry's reach, at a given distance from a place, in m."""
    while True:
        angle, distance = random.uniform(-math.pi, math.pi), random.uniform(nearest, farthest)
        point = place + distance * np.array([math.cos(angle), math.sin(angle)])
        if np.abs(point).max() < 0.8:
            return point
