"""Layers that control."""

from __future__ import annotations

from typing import Any

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.blocks.block import ControllerBlock
from physx_gym.env.layers.block_layer import BlockLayer
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.spaces import neutral


class ControlledEnv(BlockLayer):
    """Takes a controller's actions instead of those of the environment below.

    The controller's state, if it has one, is added to the observation as ``states.<block>``, and,
    with `augment_observation`, its action as ``actions.<block>``.

    Attributes:
        controller: The block.
        augment_observation: Whether the action is observed.
    """

    def __init__(
        self, env: PipelineEnv, controller: ControllerBlock, augment_observation: bool = False
    ) -> None:
        """Put a controller on the environment that it was created for.

        Raises:
            ConfigError: If it is not a controller, was created for another environment, or its name
                is taken.
        """
        if not isinstance(controller, ControllerBlock):
            raise ConfigError(f"ControlledEnv needs a ControllerBlock, not {controller!r}.")
        self.controller, self.augment_observation = controller, augment_observation
        super().__init__(env, controller)

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        """Time between two commands of the block, in s."""
        return self.controller.period or self.env.control_dt

    def _initialize_actions(self) -> None:
        controller = self.controller
        if self._build >= 0 and self.action_space is controller.action_space:
            return
        self.action_space = controller.action_space
        self.action = neutral(self.action_space)
        self.register_variable("action", self.action, controller.fieldnames, controller.name)

    def _add_parts(self) -> None:
        if self.augment_observation:
            self._add_part("actions", self.action_space, self.action)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Run the block, if it is due, then let the layer below command the motors."""
        schedule = self._schedule
        target, frame = schedule.target, schedule.stepper.iter
        if frame != schedule.last and frame % schedule.every == 0:
            schedule.last = frame
            schedule.run(action, target)
        schedule.act(target, command)
