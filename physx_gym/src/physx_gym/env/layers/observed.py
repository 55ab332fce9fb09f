"""Layers that observe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from physx_core.errors import ConfigError
from physx_gym.blocks.block import ObserverBlock
from physx_gym.env.layers.block_layer import BlockLayer
from physx_gym.env.pipeline_env import PipelineEnv


class ObservedEnv(BlockLayer):
    """Adds an observer's features to the observation, as ``features.<block>``.

    The observer's state, if it has one, is added as ``states.<block>``.

    Attributes:
        observer: The block.
    """

    def __init__(self, env: PipelineEnv, observer: ObserverBlock) -> None:
        """Put an observer on the environment that it was created for.

        Raises:
            ConfigError: If it is not an observer, was created for another environment, or its name
                is taken.
        """
        if not isinstance(observer, ObserverBlock):
            raise ConfigError(f"ObservedEnv needs an ObserverBlock, not {observer!r}.")
        self.observer = observer
        super().__init__(env, observer)

    @property
    def observe_dt(self) -> float:  # type: ignore[override]
        """Time between two observations of the block, in s."""
        return self.observer.period or self.env.observe_dt

    def _add_parts(self) -> None:
        observer = self.observer
        self._add_part("features", observer.observation_space, observer.observation)
        self.register_variable("feature", observer.observation, observer.fieldnames, observer.name)

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the observation of the layers below, then run the block, if it is due."""
        schedule = self._schedule
        schedule.observe(measurement)
        frame = schedule.stepper.iter
        if frame != schedule.last and frame % schedule.every == 0:
            schedule.last = frame
            schedule.run(measurement)
