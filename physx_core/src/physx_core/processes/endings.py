"""Endings of user code that are no errors, as by ``sys.exit``: a run they end is not finished."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from types import FrameType, TracebackType


def is_ending(error: BaseException) -> bool:
    """Return whether user code ended by what is neither an error nor an interrupt.

    These are SystemExit, GeneratorExit, asyncio's CancelledError and classes of the user's own.
    What physx itself raises to end a run, as after SIGTERM, is not meant.
    """
    if isinstance(error, (Exception, KeyboardInterrupt)):
        return False
    return not type(error).__module__.startswith("physx_core.")


def describe_ending(error: BaseException) -> str:
    """Return what ended where, without a full stop."""
    if (place := _place(error)) is None:
        return repr(error)
    frame, line = place
    name, file = frame.f_code.co_qualname, Path(frame.f_code.co_filename).name
    return f"{name}() ({file}, line {line}) raised {error!r}"


def passes_through(trace: TracebackType | None, *packages: str) -> bool:
    """Return whether a traceback contains a call of a function of one of these packages."""
    return any(_package(frame) in packages for frame, _ in traceback.walk_tb(trace))


def ends_in(error: BaseException, *packages: str) -> bool:
    """Return whether a function of one of these packages raised the error."""
    place = _place(error)
    return place is not None and _package(place[0]) in packages


def _place(error: BaseException) -> tuple[FrameType, int] | None:
    """Return the frame and line that raised an error; None if it was never raised.

    Libraries such as wandb replace `sys.exit`: then it is what called it.
    """
    leave = getattr(getattr(sys.exit, "__func__", sys.exit), "__code__", None)
    places = list(traceback.walk_tb(error.__traceback__))
    return next((each for each in reversed(places) if each[0].f_code is not leave), None)


def _package(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0]
