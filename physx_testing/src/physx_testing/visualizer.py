"""Contract checks for visualizers."""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.components import Event, Factory, Visualizer
from physx_core.errors import VisualizerError
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, run_checks
from physx_testing.scene import OBJECTS, add_all, move_all
from physx_testing.subject import Check, Subject, refuses_unknown_options

Make = Callable[[], Visualizer]
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_PATIENCE = 5.0
"""Seconds after `close` within which everything a visualizer started must have ended."""


def check_visualizer(
    component: str | type[Any] | Callable[..., Visualizer],
    *,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a visualizer satisfies the contract of `Visualizer`, without a display.

    Args:
        component: Its class, a function that returns it, or a reference.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "visualizer",
        component,
        kwargs,
        expected_failures=expected_failures,
        timeout=timeout,
    )


@contextlib.contextmanager
def _no_display() -> Iterator[None]:
    kept = {name: os.environ.pop(name) for name in _DISPLAYS if name in os.environ}
    try:
        yield
    finally:
        os.environ.update(kept)


@contextlib.contextmanager
def _opened(make: Make, folder: Path, instances: int = 1) -> Iterator[Visualizer]:
    visualizer = make()
    visualizer.open("run", folder, instances)
    try:
        yield visualizer
    finally:
        visualizer.close()


def _draws(kind: str, make: Make, folder: Path) -> None:
    """Add objects of a kind, move them, and remove them again."""
    factory = Factory()
    with _opened(make, folder) as visualizer:
        OBJECTS[kind].add(factory)
        visualizer.events(1, 0, factory.take_events())
        OBJECTS[kind].move(factory)
        visualizer.events(1, 1, factory.take_events())
        if kind not in {"view", "controls"}:  # which stay
            factory.remove(kind)
            visualizer.events(1, 2, factory.take_events())


def _many(make: Make, folder: Path) -> None:
    factory = Factory()
    names = [f"box {number}" for number in range(20)]
    with _opened(make, folder) as visualizer:
        for name in names:
            factory.add_box(name, [0.1, 0.1, 0.1])
        visualizer.events(1, 0, factory.take_events())
        positions = np.arange(60.0).reshape(20, 3)
        turns = np.tile([0.0, 0.0, 0.0, 1.0], (20, 1))
        factory.update_many("box", names, {"position": positions, "orientation": turns})
        factory.set_time(0.1)
        visualizer.events(1, 1, factory.take_events())


def _unknown(make: Make, folder: Path) -> None:
    with _opened(make, folder) as visualizer, contextlib.suppress(VisualizerError):
        visualizer.events(1, 0, [Event("add", "of a later version", ("new",), {"size": 3})])


def _several_instances(make: Make, folder: Path) -> None:
    factories = {number: Factory() for number in (1, 2, 3)}
    with _opened(make, folder, len(factories)) as visualizer:
        for step in range(3):
            for number in (2, 1, 3):
                (move_all if step else add_all)(factories[number])
                visualizer.events(number, step, factories[number].take_events())


def _closed(make: Make, folder: Path) -> None:
    visualizer, factory = make(), Factory()
    add_all(factory)
    events = factory.take_events()
    visualizer.events(1, 0, events)
    visualizer.scalars({"loss": 1.0}, 0, "batch")
    visualizer.open("run", folder, 1)
    visualizer.close()
    visualizer.events(1, 1, events)
    visualizer.close()


def _opens_again(make: Make, folder: Path) -> None:
    visualizer = make()
    outputs: set[str] = set()
    for run in range(2):
        factory = Factory()
        visualizer.open("run", folder, 1)
        add_all(factory)
        visualizer.events(1, 0, factory.take_events())
        visualizer.close()
        lines = visualizer.outputs()
        if run and set(lines) & outputs:
            raise AssertionError(f"the second run overwrote what the first one left: {lines}")
        outputs |= set(lines)


def _outputs(make: Make, folder: Path) -> None:
    factory = Factory()
    with _opened(make, folder) as visualizer:
        add_all(factory)
        visualizer.events(1, 0, factory.take_events())
    lines = visualizer.outputs()
    if not lines:
        raise NotApplicableError("it leaves no files")
    for line in lines:
        what, colon, rest = line.partition(": ")
        path = Path(rest.partition("  (")[0])
        content = any(path.iterdir()) if path.is_dir() else path.is_file() and path.stat().st_size
        if not (what and colon and content):
            raise AssertionError(f'"{line}" does not name a file that it left, as "what: PATH"')


def _changes_nothing(make: Make, folder: Path) -> None:
    factory = Factory()
    with _opened(make, folder) as visualizer:
        for step in range(3):
            (move_all if step else add_all)(factory)
            events = factory.take_events()
            before = [copy.deepcopy(dict(event.values)) for event in events]
            visualizer.events(1, step, events)
            for event, values in zip(events, before, strict=True):
                if not all(_same(event.values[name], values[name]) for name in values):
                    raise AssertionError(f'it changed the values of the event of "{event.name}"')


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return np.array_equal(one, other)


def _numbers(make: Make, folder: Path) -> None:
    with _opened(make, folder) as visualizer:
        visualizer.begin("training", None, "batches")
        for step, value in enumerate((1.0, np.nan, np.inf, -np.inf, 0.0)):
            visualizer.scalars({"loss/training": value, "lr": 1e-3}, step, "batch")
            visualizer.advance(1)
        arrays = {"weights/a": np.zeros(3), "weights/b": np.zeros(0), "c": np.array([1.0, np.nan])}
        visualizer.histograms(arrays, 1, "epoch")
        visualizer.note("stopped early")
        visualizer.end()


def _pictures(make: Make, folder: Path) -> None:
    factory = Factory()
    with _opened(make, folder) as visualizer:
        OBJECTS["box"].add(factory)
        visualizer.events(1, 0, factory.take_events())
        first = visualizer.capture() if isinstance(visualizer, Visualizer) else None
        if first is None:
            raise NotApplicableError("it has no pictures")
        OBJECTS["box"].move(factory)
        visualizer.events(1, 1, factory.take_events())
        second = visualizer.capture()
    if second is None or first.ndim != 3 or first.shape[2] != 3 or first.dtype != np.uint8:
        raise AssertionError(f"a picture is {first.dtype} of shape {first.shape}")
    if first.shape != second.shape or np.array_equal(first, second):
        raise AssertionError("a box moved, but the picture did not change")


def _leaves_nothing(make: Make, folder: Path) -> None:
    before = set(threading.enumerate())
    _outputs_or_none(make, folder)
    deadline = time.monotonic() + _PATIENCE
    while left := set(threading.enumerate()) - before:
        if time.monotonic() > deadline:
            raise AssertionError(f"threads still run after close: {[each.name for each in left]}")
        time.sleep(0.05)


def _outputs_or_none(make: Make, folder: Path) -> None:
    with contextlib.suppress(NotApplicableError):
        _outputs(make, folder)


def _check(check: Callable[[Make, Path], None]) -> Check:
    """Return a check of a subject that runs without a display."""

    def checked(subject: Subject) -> None:
        with _no_display():
            check(subject.make, subject.folder)

    return checked


_OTHERS: dict[str, Callable[[Make, Path], None]] = {
    "draws many objects at once": _many,
    "ignores or refuses a kind that it does not know": _unknown,
    "draws several instances": _several_instances,
    "ignores what comes before open and after close": _closed,
    "opens again, and keeps what it left before": _opens_again,
    "names the files that it leaves": _outputs,
    "does not change what it draws": _changes_nothing,
    "takes numbers that are not finite": _numbers,
    "shows motion in its pictures": _pictures,
    "leaves no thread behind": _leaves_nothing,
}

CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    **{f"draws {kind}": _check(functools.partial(_draws, kind)) for kind in OBJECTS},
    **{name: _check(check) for name, check in _OTHERS.items()},
}
