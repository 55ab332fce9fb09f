"""Attachments as engines get them, and those that are active."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from physx_core.rotations import from_matrix_rows, to_matrix
from physx_core.typing import Vector
from physx_sim import AppliedAttachment, Attachment, Connect, Weld
from physx_sim.errors import SimulationError


@dataclass(frozen=True, eq=False)
class Bond:
    """An attachment in numbers.

    Attributes:
        bodies: Two indices into `Layout.bodies`; -1: the world. One at least can move.
        frames: In the frame of each, what coincides, as homogeneous matrices (4, 4), in m.
        rigid: Whether the frames' axes coincide, too, not only their origins.
    """

    bodies: tuple[int, int]
    frames: tuple[Vector, Vector]
    rigid: bool


def filled(attachment: Attachment, poses: Sequence[Vector]) -> Attachment:
    """Return an attachment with what is left to the moment of attaching.

    Args:
        attachment: The attachment.
        poses: Poses (4, 4) of its two bodies at that moment.
    """
    held = np.linalg.inv(poses[0]) @ poses[1]
    if isinstance(attachment, Weld):
        if attachment.position is None:
            attachment = replace(attachment, position=tuple(held[:3, 3].tolist()))
        if attachment.orientation is None:
            turn = from_matrix_rows(held[None, :3, :3])[0]
            attachment = replace(attachment, orientation=tuple(turn.tolist()))
    elif isinstance(attachment, Connect) and attachment.point_b is None:
        point = np.linalg.solve(held, [*attachment.point_a, 1.0])[:3]
        attachment = replace(attachment, point_b=tuple(point.tolist()))
    return attachment


def frames_of(attachment: Attachment) -> tuple[Vector, Vector]:
    """Return what coincides in the frames of both bodies of a filled attachment, (4, 4) each."""
    first, second = np.eye(4), np.eye(4)
    if isinstance(attachment, Weld):
        first[:3, 3] = attachment.position
        first[:3, :3] = to_matrix(attachment.orientation or ())
    elif isinstance(attachment, Connect):
        first[:3, 3], second[:3, 3] = attachment.point_a, attachment.point_b
    return first, second


class Attachments:
    """The active attachments of a world.

    Args:
        bind: Makes an engine hold two bodies together, given a number and a filled attachment.
        unbind: Ends that, given the number.
    """

    def __init__(
        self, bind: Callable[[int, Attachment], None], unbind: Callable[[int], None]
    ) -> None:
        self._bind, self._unbind = bind, unbind
        self._active: dict[int, Attachment] = {}
        self._next = 0

    def __len__(self) -> int:
        """Return the number of active attachments."""
        return len(self._active)

    def hold(self, body: str) -> bool:
        """Return whether anything holds a body."""
        return any(body in (each.body_a, each.body_b) for each in self._active.values())

    def add(self, attachment: Attachment) -> int:
        """Attach two bodies; return the attachment's number."""
        number = self._next
        self._bind(number, attachment)
        self._active[number], self._next = attachment, number + 1
        return number

    def remove(self, number: int) -> None:
        """End an attachment."""
        if number not in self._active:
            known = sorted(self._active)
            raise SimulationError(
                f"No attachment has the number {number!r}; active attachments: {known}."
            )
        self._unbind(number)
        del self._active[number]

    def snapshot(self) -> tuple[AppliedAttachment, ...]:
        """Return all active attachments."""
        return tuple(AppliedAttachment(*each) for each in self._active.items())

    def restore(self, applied: Iterable[AppliedAttachment]) -> None:
        """Replace all active attachments."""
        wanted = {each.number: each.attachment for each in applied}
        self._next = max([self._next, *(number + 1 for number in wanted)])
        for number in list(self._active):  # all of them, as static bodies may be elsewhere now
            self.remove(number)
        for number, attachment in wanted.items():
            self._bind(number, attachment)
            self._active[number] = attachment
