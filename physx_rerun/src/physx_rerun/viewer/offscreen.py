"""Renders successive pictures of a moving scene with a viewer without a window."""

from __future__ import annotations

import io
import time

import numpy as np
from PIL import Image

from physx_core.errors import VisualizerError
from physx_core.processes import TemporaryFolder
from physx_core.typing import Array
from physx_rerun.viewer.headless import Camera, start_viewer

_MARGIN = (8, 36)  # pixels around a view: its frame and title, without the menu bar
_PATIENCE = 60.0  # s per picture


class OffscreenViewer:
    """A viewer without a window.

    Attributes:
        address: Address of the viewer, ``127.0.0.1:PORT``.
    """

    def __init__(self, size: tuple[int, int], memory_limit: str) -> None:
        """Start the viewer.

        Args:
            size: Width and height of its pictures in pixels.
            memory_limit: Memory limit of the viewer, beyond which it drops the oldest rows.
        """
        self._size = size
        self._folder = TemporaryFolder("rerun-")
        window = (size[0] + _MARGIN[0], size[1] + _MARGIN[1])
        limits = ("--memory-limit", memory_limit, "--server-memory-limit", "100MB")
        self._viewer = start_viewer(window, self._folder.path, *limits)
        self._camera: Camera | None = None
        self.address = self._viewer.address
        try:
            self._viewer.wait_until_ready()
        except VisualizerError:
            self.close()
            raise

    def picture(self, step: int, mark: str, number: int) -> Array:
        """Return a picture of the scene, shape (height, width, 3), uint8.

        Args:
            step: Position on the timeline ``step`` to draw.
            mark: Timeline of the last row that must have arrived.
            number: Position of the row on that timeline.
        """
        deadline = time.monotonic() + _PATIENCE
        try:
            is_first = self._camera is None
            camera = self._camera or Camera(self._viewer, deadline)
            camera.deadline = deadline
            scene = camera.wait_for_position(mark, number)
            if is_first:
                camera.wait_for_recording()
                scene = camera.wait_for_position(mark, number)
            if scene is None:
                raise VisualizerError("There is no scene to render: nothing was drawn.")
            camera.go_to("step", step)
            drawn = camera.wait_for_picture(scene) if is_first else camera.screenshot(scene)
        except OSError as error:
            self._viewer.check(wait=2.0)
            raise VisualizerError(f"The Rerun viewer did not render a picture: {error}.") from error
        self._camera = camera
        return _crop(Image.open(io.BytesIO(drawn)), self._size)

    def close(self) -> None:
        """End the viewer."""
        self._viewer.end()
        self._folder.close()


def _crop(picture: Image.Image, size: tuple[int, int]) -> Array:
    """Crop a picture to its center; a picture that is too small is enlarged first."""
    factor = max(1.0, *(want / have for want, have in zip(size, picture.size, strict=True)))
    if factor > 1.0:
        whole = [round(factor * have) for have in picture.size]
        picture = picture.resize((max(whole[0], size[0]), max(whole[1], size[1])))
    left, top = ((have - want) // 2 for have, want in zip(picture.size, size, strict=True))
    cut = picture.convert("RGB").crop((left, top, left + size[0], top + size[1]))
    return np.asarray(cut).copy()
