"""Observer and Visualizer: they look on and never take part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from physx_core.components.scene import Event
    from physx_core.typing import Array


class Observer:
    """Looks on while a pipeline runs. All methods do nothing until a subclass fills them.

    An observer that raises is reported once and then left out; the run goes on.
    """

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """A run begins.

        Args:
            run_name: Name of the session.
            session_dir: The session's folder.
            instance_nb: How many environment instances may draw.
        """

    def begin(self, task: str, total: int | None, unit: str) -> None:
        """A loop begins.

        Args:
            task: What is done, for example ``training``.
            total: How many units there are to do; None: nobody knows.
            unit: What is counted, for example ``samples``.
        """

    def advance(self, count: int) -> None:
        """The loop did `count` units more."""

    def end(self) -> None:
        """The loop is over."""

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Numbers to record.

        Args:
            values: Name to value; a ``/`` in a name makes groups, as in ``loss/training``.
            step: Position on the timeline.
            timeline: ``batch``, ``epoch`` or ``step``.
        """

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Arrays of numbers whose distribution is to be recorded.

        Args:
            values: Name to array, for example ``weights/layers.0.weight``.
            step: Position on the timeline.
            timeline: ``epoch``.
        """

    def note(self, text: str) -> None:
        """Something worth telling happened, for example that a training stopped early."""

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Drawing events of one environment instance at one of its steps."""

    def close(self) -> None:
        """The run is over, whether it succeeded or not."""


class Visualizer(Observer):
    """An observer that draws what the environments' factories emit."""

    def capture(self) -> Array | None:
        """Return a picture, shape (height, width, 3), uint8; None: it makes no pictures."""
        return None
