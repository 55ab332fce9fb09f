"""The layer of rewards and terminations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from physx_core.errors import ConfigError
from physx_gym.env.layers.layer import Layer
from physx_gym.env.pipeline_env import Info, PipelineEnv
from physx_gym.tasks.rewards import Reward
from physx_gym.tasks.terminations import Termination
from physx_gym.tasks.trajectory import Trajectory


class ComposedEnv(Layer):
    """Adds a reward and terminations to an environment.

    The reward is added to that of the layers below; the information has each of its parts, as
    ``"reward_<name>"``. An episode ends when the layers below or one of the terminations end it;
    ``info["terminations"]`` names the terminations that did.

    Attributes:
        reward: The reward; None: none is added.
        terminations: The terminations.
    """

    constants: ClassVar[tuple[str, ...]] = ("reward", "terminations")

    def __init__(
        self,
        env: PipelineEnv,
        *,
        reward: Reward | None = None,
        terminations: Sequence[Termination] | Termination = (),
        trajectory: Trajectory | None = None,
    ) -> None:
        """Add a reward and terminations to an environment.

        Args:
            env: The environment.
            reward: The reward to add.
            terminations: One or more terminations to add, with different names.
            trajectory: The reference that quantities may be compared with; None: that of a layer
                below, if there is one.

        Raises:
            ConfigError: If an argument is of the wrong type, two terminations have the same name,
                or the trajectory is of another robot.
        """
        if isinstance(terminations, Termination):
            terminations = (terminations,)
        _check(reward, terminations)
        self.reward, self.terminations = reward, tuple(terminations)
        super().__init__(env)
        quantities = env.quantities
        if trajectory is not None:
            if not isinstance(trajectory, Trajectory):
                raise ConfigError(f"ComposedEnv.trajectory is {trajectory!r}, not a Trajectory.")
            state = env.robot_state
            shapes = (trajectory.positions.shape[1], trajectory.velocities.shape[1])
            if shapes != (len(state.q), len(state.v)):
                raise ConfigError(
                    f"The trajectory has {shapes[0]} positions and {shapes[1]} velocities, but the "
                    f"robot has {len(state.q)} and {len(state.v)}."
                )
            quantities.trajectory = trajectory
        for part in (*terminations, *(() if reward is None else (reward,))):
            for quantity in part.watched:
                quantities.watch(quantity)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the layers below or a termination end the episode."""
        terminated, truncated = self.env.has_terminated(info)
        t = self.env.stepper_state.t
        fired = [
            each
            for each in self.terminations
            if t >= each.grace_period
            and (self.unwrapped.training or not each.training_only)
            and each.holds(self.env.quantities)
        ]
        if fired:
            info["terminations"] = [*info.get("terminations", []), *(each.name for each in fired)]
        terminated |= any(not each.is_truncation for each in fired)
        return terminated, truncated | any(each.is_truncation for each in fired)

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of the layers below plus that of this layer."""
        total = self.env.compute_reward(terminated, info)
        if self.reward is not None:
            parts: dict[str, float] = {}
            own = self.reward.compute(self.env.quantities, terminated, parts)
            parts[self.reward.name] = own
            for name, value in parts.items():  # numbers, not a dictionary: TorchRL reads them
                info[f"reward_{name}"] = value
            total += own
        return total


def _check(reward: Any, terminations: Sequence[Any]) -> None:
    if reward is not None and not isinstance(reward, Reward):
        raise ConfigError(f"ComposedEnv.reward is {reward!r}, which is not a Reward.")
    for each in terminations:
        if not isinstance(each, Termination):
            raise ConfigError(f"{each!r} is not a Termination.")
    names = [each.name for each in terminations]
    if len(set(names)) < len(names):
        raise ConfigError(f"Two terminations have the same name: {sorted(names)}.")
