"""Tasks with a goal, and their versions for hindsight experience replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core.errors import ConfigError, listed
from physx_core.typing import Vector
from physx_gym.env.pipeline_env import Info
from physx_gym.env.robot_env import RobotEnv
from physx_gym.environments import limits

_REWARD_TYPES = ("sparse", "dense")


class GoalTask(RobotEnv):
    """An environment whose observation ends with the vector from the achieved position to the goal.

    Attributes:
        ACHIEVED: Slice of the observation that contains the achieved position.
        CLOSE: Distance from the goal below which it counts as reached, in m.
        goal: The goal of the episode, shape (dimensions,), in m.
    """

    ACHIEVED: ClassVar[slice]
    CLOSE: ClassVar[float]
    goal: Vector

    @property
    def _seen(self) -> Vector:
        """The whole observation, with the vector to the goal, to be updated in place."""
        seen: Vector = self.observation
        return seen


class GoalEnv(GoalTask):
    """Observes goals as Gymnasium-Robotics' ``GoalEnv`` does, so that hindsight can replace them.

    It must be the first base class, before that of a `GoalTask`. The observation is a dictionary of
    ``"observation"``, that of the task without the vector to the goal, ``"achieved_goal"`` and
    ``"desired_goal"``. The reward depends only on the two goals, and no episode terminates.
    """

    constants: ClassVar[tuple[str, ...]] = ("_flat", "_is_sparse")

    def __init__(self, *, reward_type: str = "sparse", **options: Any) -> None:
        """Create the environment.

        Args:
            reward_type: ``"sparse"``: 0 while the goal is reached, otherwise -1; ``"dense"``: minus
                the distance from the goal, in m.
            options: Options of the task.

        Raises:
            ConfigError: If there is no such type.
        """
        if reward_type not in _REWARD_TYPES:
            raise ConfigError(
                f"reward_type is {reward_type!r} but must be one of {listed(_REWARD_TYPES)}."
            )
        self._is_sparse = reward_type == "sparse"
        super().__init__(**options)

    def _initialize_observation_space(self) -> None:
        super()._initialize_observation_space()
        whole: Any = self.observation_space
        bounds = whole.high
        self._flat = np.zeros(len(bounds))
        self.observation_space = spaces.Dict(
            {
                "observation": limits.box(bounds[: -len(self.goal)]),
                "achieved_goal": limits.box(bounds[self.ACHIEVED]),
                "desired_goal": limits.box(bounds[self.ACHIEVED]),
            }
        )

    @property
    def _seen(self) -> Vector:
        return self._flat

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe what the task observes, and both goals."""
        super().refresh_observation(measurement)
        self.observation["observation"][:] = self._flat[: -len(self.goal)]
        self.observation["achieved_goal"][:] = self._flat[self.ACHIEVED]
        self.observation["desired_goal"][:] = self.goal

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return no termination, and whether the task is truncated."""
        _, truncated = super().has_terminated(info)
        achieved, desired = self.observation["achieved_goal"], self.observation["desired_goal"]
        info["is_success"] = bool(self._distance(achieved, desired) < self.CLOSE)
        return self.compute_terminated(achieved, desired, info), truncated

    def compute_reward(self, *given: Any) -> Any:
        """Return the reward of this step, or rewards for other goals.

        Args:
            given: Whether the step terminated the episode, and its information, as in
                `PipelineEnv.compute_reward`; or, as in Gymnasium-Robotics, achieved goals, desired
                goals, each of shape (dimensions,) or (samples, dimensions), and information.

        Returns:
            A number; or rewards, shape (samples,).
        """
        if len(given) == 2:
            goals = self.observation["achieved_goal"], self.observation["desired_goal"]
            return float(self._rate(*goals))
        achieved, desired, _ = given
        return self._rate(achieved, desired)

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> bool:
        """Return False: no goal terminates an episode, as it must be held."""
        return False

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> bool:
        """Return False: no goal truncates an episode."""
        return False

    def _rate(self, achieved: Any, desired: Any) -> Any:
        distance = self._distance(achieved, desired)
        return -(distance >= self.CLOSE).astype(np.float64) if self._is_sparse else -distance

    @staticmethod
    def _distance(achieved: Any, desired: Any) -> Any:
        return np.linalg.norm(np.subtract(achieved, desired), axis=-1)
