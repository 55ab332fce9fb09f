"""Wrenches and hooks that act on a world while it is stepped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from physx_core.typing import Vector
from physx_sim import AppliedWrench, Hook, Simulation, Wrench
from physx_sim.errors import SimulationError


class Wrenches:
    """The active wrenches of a world."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._active: dict[int, AppliedWrench] = {}
        self._next = 0

    def __len__(self) -> int:
        """Return the number of active wrenches."""
        return len(self._active)

    def add(self, wrench: Wrench, frame: int) -> int:
        """Apply a wrench starting at a frame; return its number."""
        number, self._next = self._next, self._next + 1
        self._active[number] = AppliedWrench(number, frame, wrench)
        return number

    def remove(self, number: int) -> None:
        """Remove a wrench."""
        if number not in self._active:
            raise SimulationError(
                f"No wrench has the number {number!r}; active wrenches: {sorted(self._active)}."
            )
        del self._active[number]

    def at(self, frame: int) -> Iterator[tuple[Wrench, Vector, Vector]]:
        """Drop expired wrenches; yield each remaining one with its force and torque."""
        for number, applied in list(self._active.items()):
            steps = applied.wrench.steps(self._period)
            if steps is not None and frame >= applied.begin + steps:
                del self._active[number]
            else:
                time = (frame - applied.begin) * self._period
                yield applied.wrench, *applied.wrench.at(time)

    def before(self, frame: int) -> Iterator[tuple[Wrench, Vector, Vector]]:
        """Yield each wrench that acted in the step before a frame, with its force and torque."""
        for applied in self._active.values():
            steps, since = applied.wrench.steps(self._period), frame - 1 - applied.begin
            if since >= 0 and (steps is None or since < steps):
                yield applied.wrench, *applied.wrench.at(since * self._period)

    def snapshot(self) -> tuple[AppliedWrench, ...]:
        """Return all active wrenches."""
        return tuple(self._active.values())

    def restore(self, applied: Iterable[AppliedWrench]) -> None:
        """Replace all active wrenches."""
        self._active = {each.number: each for each in applied}
        self._next = max([self._next, *(number + 1 for number in self._active)])


class Hooks:
    """Functions called before physics steps."""

    def __init__(self) -> None:
        self._hooks: list[tuple[Hook, int]] = []

    def __len__(self) -> int:
        """Return the number of hooks."""
        return len(self._hooks)

    def add(self, hook: Hook, every: int) -> None:
        """Call a function before the steps whose frame is a multiple of `every`."""
        if not callable(hook):
            raise SimulationError(f"{hook!r} is not callable, so it cannot be a hook.")
        self._hooks.append((hook, every))

    def remove(self, hook: Hook) -> None:
        """Remove a hook."""
        for place, (known, _) in enumerate(self._hooks):
            if known == hook:
                del self._hooks[place]
                return
        raise SimulationError(f"{hook!r} is not a hook of this simulation.")

    def clear(self) -> None:
        """Remove all hooks."""
        self._hooks.clear()

    def pause(self, frame: int) -> int:
        """Return the number of steps from a frame until the next call, at least 1."""
        return min((every - frame % every for _, every in self._hooks), default=2**30)

    def call(self, simulation: Simulation, frame: int) -> None:
        """Call the hooks that are due at a frame."""
        for hook, every in tuple(self._hooks):
            if frame % every == 0:
                hook(simulation)
