"""Observer and Visualizer: base classes of read-only callbacks, which cannot affect a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from physx_core.closeable import Closeable

if TYPE_CHECKING:
    from pathlib import Path

    from physx_core.components.scene.event import Event
    from physx_core.fields import Field
    from physx_core.typing import Array


class Observer(Closeable):
    """Receives the events of a running pipeline. All methods do nothing unless overridden.

    An observer that raises is reported once and then ignored; the run continues.
    """

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Called at the start of a run.

        Args:
            run_name: Name of the session.
            session_dir: The session's folder.
            instance_nb: Number of environment instances that can draw.
        """

    def announcements(self) -> Sequence[str]:
        """Return lines for the user at the start of a run, for example ``viewer: URL``.

        Called after `open`.
        """
        return ()

    def begin(self, task: str, total: int | None, unit: str) -> None:
        """Called at the start of a loop.

        Args:
            task: Name of the loop, for example ``training``.
            total: Number of units in the loop; None: unknown.
            unit: Name of the units, for example ``samples``.
        """

    def advance(self, count: int) -> None:
        """Called after `count` more units of the loop."""

    def end(self) -> None:
        """Called at the end of the loop."""

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Record numbers.

        Args:
            values: Name to value; a ``/`` in a name separates groups, as in ``loss/training``.
            step: Position on the timeline.
            timeline: ``batch``, ``epoch`` or ``step``.
        """

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Record the distribution of numbers in arrays.

        Args:
            values: Name to array, for example ``weights/layers.0.weight``.
            step: Position on the timeline.
            timeline: ``epoch``.
        """

    def fields(self, fields: Sequence[Field]) -> None:
        """Receive the fields of the training samples, with their units, before the first numbers.

        Args:
            fields: The fields.
        """

    def predictions(
        self, predicted: Mapping[str, Array], truth: Mapping[str, Array], step: int, timeline: str
    ) -> None:
        """Compare predictions of some validation samples with the truth.

        Args:
            predicted: Field name to array of shape (samples, *field shape), in the field's unit.
            truth: The same for what the network should have predicted.
            step: Position on the timeline.
            timeline: ``epoch``.
        """

    def flush(self) -> None:
        """Called before a checkpoint: store what a killed run needs in order to resume from it."""

    def note(self, text: str) -> None:
        """Receive a message, for example that a training stopped early."""

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Receive drawing events of one environment instance at one of its steps."""

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does to an environment, before each of its rows.

        An observer that overrides this gets the controls of each instance as an object of the kind
        ``controls`` in its first `events`. It may wait here, to hold the simulation back.

        Returns:
            The values of the controls, one for each of its ``labels``; then the index of the pulled
            object in ``pulls``, or -1, the node, and the force in N, (3,). Empty: nothing.
        """
        return ()

    def close(self) -> None:
        """Called at the end of the run, also after a failure."""

    def outputs(self) -> Sequence[str]:
        """Return a line for each file or folder that it wrote, for example ``recording: PATH``.

        A command that shows it may follow after two blanks, in brackets; the run prints it as the
        next command. Called after `close`.
        """
        return ()


def takes_hand(visualizer: Any) -> bool:
    """Return whether a person can touch environments in a visualizer of this class."""
    return getattr(visualizer, "touch", Observer.touch) is not Observer.touch


@dataclass(frozen=True)
class Cursor:
    """Where the cursor of an open viewer stands.

    Attributes:
        timeline: Name of the timeline, such as ``row``.
        position: The position on it.
        options: Arguments of a visualizer that draws in the same viewer.
    """

    timeline: str
    position: int
    options: Mapping[str, Any]


class Visualizer(Observer):
    """An observer that draws the events of the environments' factories."""

    @classmethod
    def offscreen(cls, size: tuple[int, int]) -> Self | None:
        """Return one whose `capture` draws without a display; None if there is none.

        Reports draw films and pictures with it.

        Args:
            size: Width and height of the pictures in pixels.
        """
        return None

    @classmethod
    def cursor(cls) -> Cursor | None:
        """Return where the cursor of an open viewer stands; None if viewers have none.

        Raises:
            VisualizerError: If no viewer is open, or it shows nothing.
        """
        return None

    def capture(self) -> Array | None:
        """Return a picture, shape (height, width, 3), uint8; None if pictures are not supported."""
        return None
