"""EnvironmentDrawing: the present state of an environment, drawn with a factory."""

from __future__ import annotations

from physx_core import plugins
from physx_core.components import Factory
from physx_gym.visualization.drawing import WorldDrawing
from physx_gym.visualization.playable import Drawable
from physx_sim import World


class EnvironmentDrawing:
    """Draws an environment's world, and what the environment itself adds to the scene.

    Attributes:
        world: The world that was drawn; None before the first call of `draw`.
    """

    def __init__(self, env: Drawable, factory: Factory, *, follow: bool = True) -> None:
        """Store the arguments.

        Args:
            env: The environment, which has been reset.
            factory: Factory to draw with.
            follow: Whether the camera follows a robot whose base floats.
        """
        self._env, self._factory, self._follow = env, factory, follow
        self._drawing: WorldDrawing | None = None
        self.world: World | None = None

    def draw(self) -> None:
        """Draw the present state: add everything at first, later move it."""
        simulator = self._env.simulator
        if self._drawing is not None:
            self._drawing.show(simulator.simulation)
            self._env._redraw(self._factory)
            return
        self.world = simulator.world
        self._drawing = WorldDrawing(
            self._factory,
            simulator.world,
            plugins.resolve("backend", simulator.backend),
            simulator.layout,
            type(self._env).__name__,
            follow=self._follow,
            view=self._env.view,
        )
        self._drawing.show(simulator.simulation)
        self._env._draw(self._factory)

    def close(self) -> None:
        """Delete temporary files; calling it again does nothing."""
        if self._drawing is not None:
            self._drawing.close()
