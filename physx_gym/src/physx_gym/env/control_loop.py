"""State of the control loop that runs a pipeline."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from physx_gym.env.action_buffer import ActionBuffer
from physx_gym.env.observation_checks import ObservationChecks
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.env.timing import StepTiming, Tick
from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import copier


class ControlLoop(SharedArrays):
    """State of `RobotEnv`'s episode, under a single name: subclasses may use all others.

    Attributes:
        is_ready: Whether `step` may be called.
        reason: If not, why, and what to do.
        timing: When to command and observe.
        schedule: The ticks of a step.
        builds: Build of the simulator that the spaces belong to.
        episode: Number of episodes since the environment was seeded.
        steps: Number of steps of the episode.
        is_recorded: Whether everything is recorded, at every tick; otherwise less, once a step.
        own_checks: Checks of the base environment's observations.
        is_finite: Whether the base environment's observation is known to be free of NaN.
        actions: Accepts actions of the outermost environment.
        checks: Checks of its observations.
        copy: Copies its observations.
    """

    timing: StepTiming
    own_checks: ObservationChecks
    actions: ActionBuffer
    checks: ObservationChecks
    copy: Callable[[Any], Any]

    def __init__(self) -> None:
        self.is_ready, self.reason = False, "Call reset() before step()."
        self.schedule: list[Tick] = []
        self.builds = self.steps = -1
        self.episode = 0
        self.is_recorded = self.is_finite = False

    def refuse(self, reason: str) -> None:
        """Reject steps until the next reset."""
        self.is_ready, self.reason = False, reason

    def connect(self, outermost: PipelineEnv, is_base: bool) -> None:
        """Take actions from the outermost environment, and check its observations."""
        space = outermost.observation_space
        self.actions = ActionBuffer(outermost.action_space, outermost.action)
        self.checks = self.own_checks if is_base else ObservationChecks(space)
        self.copy = copier(space)
