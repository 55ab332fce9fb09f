"""Rendering: pictures of a running environment, or a viewer that follows it."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core import plugins
from physx_core.components import Factory, Visualizer
from physx_core.errors import UnknownOptionError, VisualizerError
from physx_gym.defaults import VIEWER
from physx_gym.visualization.display import has_display
from physx_gym.visualization.environment_drawing import EnvironmentDrawing
from physx_gym.visualization.playable import Drawable

MODES = ("human", "rgb_array")
PICTURE_SIZE = (640, 480)
"""Width and height of a picture, in pixels, unless ``viewer_kwargs`` says otherwise."""

Picture = NDArray[np.uint8]


def open_viewer(title: str, instances: int = 1, **options: Any) -> Visualizer:
    """Open a viewer.

    Args:
        title: Title of its recording.
        instances: Number of worlds to show.
        options: Of the visualizer; ``visualizer`` is its reference, by default `VIEWER`.
    """
    options = dict(options)
    kind: Any = plugins.resolve("visualizer", options.pop("visualizer", VIEWER))
    viewer: Visualizer = kind(**options)
    viewer.open(title, Path(tempfile.gettempdir()), instances)
    sys.stderr.write("".join(f"{line}\n" for line in viewer.announcements()))
    return viewer


class Renderer:
    """Shows an environment according to its ``render_mode``, with the options ``viewer_kwargs``.

    ``"rgb_array"`` renders pictures without a window, ``"human"`` opens a viewer; None opens a
    viewer if there is a display, and renders pictures otherwise.
    """

    def __init__(self, env: Drawable, mode: str | None = None, *, follow: bool = True) -> None:
        """Store the environment; the viewer is opened at the first frame.

        Args:
            env: The environment to show.
            mode: Overrides the environment's ``render_mode``.
            follow: Whether the camera follows a robot whose base floats.
        """
        mode = mode or env.render_mode or ("human" if has_display() else "rgb_array")
        if mode not in MODES:
            raise UnknownOptionError("render_mode", [str(mode)], MODES)
        self.mode = mode
        self._env, self._follow = env, follow
        self._viewer: Visualizer | None = None
        self._factory = Factory()
        self._drawing: EnvironmentDrawing | None = None
        self._frames = 0

    def frame(self) -> Picture | None:
        """Show the present state.

        Returns:
            A picture, shape (height, width, 3); None in the mode ``"human"``.
        """
        simulator = self._env.simulator
        if self._drawing is not None and self._drawing.world is not simulator.world:
            self.close()
        if self._drawing is None or self._viewer is None:
            self._factory, self._viewer = Factory(), self._open()
            self._drawing = EnvironmentDrawing(self._env, self._factory, follow=self._follow)
        self._drawing.draw()
        self._factory.set_time(simulator.simulation.time)
        self._viewer.events(1, self._frames, self._factory.take_events())
        self._frames += 1
        if self.mode == "human":
            return None
        picture = self._viewer.capture()
        if picture is None:
            raise VisualizerError(f"{type(self._viewer).__name__} cannot render pictures.")
        return picture

    def _open(self) -> Visualizer:
        options = {"save": False} | dict(self._env.viewer_kwargs)
        if self.mode == "human":
            options = {"mode": "spawn"} | options
        else:
            options = {"mode": "offscreen", "picture_size": PICTURE_SIZE} | options
        return open_viewer(type(self._env).__name__, **options)

    def close(self) -> None:
        """Close the viewer; the next frame opens another one."""
        if self._drawing is not None:
            self._drawing.close()
        if self._viewer is not None:
            self._viewer.close()
        self._drawing = self._viewer = None
