"""Protocols of environments, for the tools that run and show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

from physx_core.components import Factory
from physx_gym.simulator.simulator import Simulator

Info = dict[str, Any]


class Drawable(Protocol):
    """An environment that can be drawn; every `RobotEnv` is one."""

    view: ClassVar[Mapping[str, Sequence[float]]]
    viewer_kwargs: dict[str, Any]
    render_mode: str | None

    @property
    def simulator(self) -> Simulator:
        """The simulated world."""

    def _draw(self, scene: Factory) -> None:
        """Draw what is not simulated."""

    def _redraw(self, scene: Factory) -> None:
        """Update what was drawn."""


class Playable(Protocol):
    """An environment that can be run; every `PipelineEnv` is one."""

    action: Any
    step_dt: float

    @property
    def render_mode(self) -> str | None:
        """How the environment is rendered."""

    @property
    def training(self) -> bool:
        """Whether the mode is training; otherwise it is evaluation."""

    @property
    def layers(self) -> tuple[Any, ...]:
        """Its layers, the base first."""

    def train(self, mode: bool = True) -> None:
        """Switch between training and evaluation."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Start an episode."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Simulate a step."""

    def stop(self) -> None:
        """End the episode."""

    def replay(self, **kwargs: Any) -> Any:
        """Show the last episode."""
