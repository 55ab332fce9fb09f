"""Film: pictures of scenes by whatever visualizer can draw without a display, and files of them."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from physx_core import Closeable, Visualizer, plugins
from physx_core.components import Event
from physx_core.errors import PhysxError, UntrustedReferenceError, VisualizerError
from physx_core.pipelines import Redrawing
from physx_core.typing import Array, Batch, Sample
from physx_report.blocks import Block, Text
from physx_report.scenes import Link, Scene, begin_prediction, end_prediction, find_links

SIZE = (480, 360)
"""Width and height of a picture, in pixels."""
MOST = 40
"""Largest number of pictures of a film."""
_SECONDS = 0.1
"""Between two pictures of a film."""
_LOOK = {"quality": 50, "method": 4}


class Camera(Closeable):
    """Takes pictures of what is drawn."""

    def __init__(self) -> None:
        """Open the first visualizer of a plugin that draws without a display.

        Raises:
            VisualizerError: If there is none, or it cannot be opened.
        """
        made = (each.offscreen(SIZE) for each in _visualizers())
        viewer = next((each for each in made if each is not None), None)
        if viewer is None:
            raise VisualizerError(
                "no plugin is installed that draws pictures without a display, such as physx-rerun"
            )
        self._viewer, self._count = viewer, 0
        self._names: dict[str, str] = {}
        viewer.open("report", Path(), 1)

    def show(self, events: Sequence[Event]) -> None:
        """Draw events."""
        for event in events:
            for name in event.names if event.action == "add" else ():
                self._names[name] = event.kind
            for name in event.names if event.action == "remove" else ():
                self._names.pop(name, None)
        self._viewer.events(1, self._count, list(events))
        self._count += 1

    def take(self) -> Array:
        """Return a picture, shape (height, width, 3).

        Raises:
            VisualizerError: If it cannot be drawn.
        """
        picture = self._viewer.capture()
        if picture is None:
            raise VisualizerError("nothing was drawn")
        return picture

    def clear(self) -> None:
        """Remove all objects."""
        known = {name: kind for name, kind in self._names.items() if kind != "view"}
        self.show([Event("remove", kind, (name,), {}) for name, kind in known.items()])

    def close(self) -> None:
        """Close the visualizer; if it has failed, the page says why."""
        with warnings.catch_warnings(action="ignore"):
            self._viewer.close()


@dataclass(frozen=True)
class Film:
    """Rows as their environment draws them, with the predictions of a network.

    Attributes:
        frames: What was drawn at each row since the one before.
        truth: The true values by field, arrays of shape (rows, ...).
        prediction: The predicted ones.
        links: What of it follows from these fields; empty: nothing.
        is_own: Whether the environment draws the predictions itself.
    """

    frames: Sequence[Sequence[Event]]
    truth: Batch
    prediction: Batch
    links: Sequence[Link]
    is_own: bool

    @property
    def look(self) -> str:
        """What pictures show, in words; empty if no predictions are to be seen."""
        if self.is_own:
            return "truth and prediction, as the environment draws them"
        if not self.links:
            return ""
        faint = ", and the truth faintly" if any(each.is_place for each in self.links) else ""
        return f"left: truth; right: prediction{faint}"

    def pictures(self, camera: Camera, wanted: Sequence[int]) -> list[Array]:
        """Return pictures of some of the rows: the truth, and right of it the prediction.

        Args:
            camera: Takes them.
            wanted: Numbers of the rows in the film, ascending.

        Raises:
            VisualizerError: If they cannot be drawn.
        """
        camera.clear()
        scene, found = Scene(), []
        for row, events in enumerate(self.frames):
            scene.take(events)
            camera.show(events)
            if row not in wanted:
                continue
            found.append(camera.take())
            if self.links:
                values = [
                    {n: v[row] for n, v in of.items()} for of in (self.truth, self.prediction)
                ]
                camera.show(begin_prediction(scene, self.links, *values))
                found[-1] = np.hstack([found[-1], camera.take()])
                camera.show(end_prediction(scene, self.links))
        return found


def _visualizers() -> Iterator[type[Visualizer]]:
    found = plugins.resolve_all("visualizer").values()
    yield from (each for each in found if isinstance(each, type) and issubclass(each, Visualizer))


def redraw(
    drawing: Redrawing,
    rows: Sequence[int],
    truth: Batch,
    prediction: Batch,
    applied: Mapping[int, Sample],
    links: Sequence[Link] = (),
) -> Film:
    """Let an environment draw rows again.

    Args:
        drawing: The environment.
        rows: Numbers of the rows, ascending: see `Redrawing.frames`.
        truth: The true values by field, arrays of shape (rows, ...).
        prediction: The predicted ones.
        applied: What the environment gets if it takes predictions, by row.
        links: What is known to follow from the fields, if these rows do not tell.

    Raises:
        PhysxError: If the environment cannot draw them.
    """
    scene, frames, drawn = Scene(), [], []
    for events in drawing.frames(rows, applied.get):
        scene.take(events)
        frames.append(events)
        drawn.append(scene.numbers())
    is_own = drawing.takes_predictions
    found = [] if is_own else find_links(drawn, truth) or list(links)
    return Film(frames, truth, prediction, found, is_own)


def or_why_not(blocks: Iterable[Block]) -> list[Block]:
    """Return blocks of films, or a sentence on why there are none."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of environments that draw nothing
            return list(blocks)
    except UntrustedReferenceError:
        told = (
            "its environment is not of an installed plugin; if you trust the code that its files "
        )
        return [Text([f"There is no film: {told}name, make the page with --trust (trust=True)."])]
    except PhysxError as error:
        return [Text([f"There is no film: {str(error).rstrip('.')}."])]


def as_file(pictures: Sequence[Array]) -> bytes:
    """Return pictures as WebP: one, or a film."""
    content = io.BytesIO()
    first, *others = [Image.fromarray(each) for each in pictures]
    more = {"save_all": True, "append_images": others, "duration": round(1000 * _SECONDS)}
    first.save(content, "webp", **_LOOK, **({**more, "loop": 0} if others else {}))
    return content.getvalue()
