"""Guards the loading of a plugin against anything that its own code may do."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from physx_core.errors import PhysxError, PluginError, printable
from physx_core.plugins.entries import unmet_requirements, unreadable_hint

if TYPE_CHECKING:
    from importlib.metadata import Distribution

TIMEOUT_VARIABLE = "PHYSX_IMPORT_TIMEOUT"
"""Environment variable with the time in s that a plugin may take to import."""
TIMEOUT = 120.0
"""Default of that time: a deep-learning library on a slow disk takes a while."""
_NOTE_TIME = 10.0


class _TimeIsUp(BaseException):
    """The import of a plugin takes too long; caught only in this module."""


@contextlib.contextmanager
def loading(
    plugin: str, who: str, doing: str, package: Distribution | None = None
) -> Iterator[None]:
    """Convert any failure in a plugin's own code to an error that names the plugin.

    This includes ``sys.exit`` and KeyboardInterrupt, unless a signal raised them. A plugin that
    takes long is reported on standard error; in the main thread, loading stops after `TIMEOUT`.

    Args:
        plugin: Name of the plugin.
        who: The plugin and its package, for messages.
        doing: Description of a failure, for example "fails to import its module".
        package: Its package, whose requirements a failure is compared with.

    Raises:
        PluginError: If the plugin raises anything, or takes too long.
    """
    limit = _timeout()
    text = f"physx: {who} is still loading; physx gives up after {limit:g} s, or on Ctrl-C"
    note = threading.Timer(min(_NOTE_TIME, limit / 2), _note, [text])
    note.daemon = True
    note.start()
    with contextlib.ExitStack() as stack:
        stack.callback(note.cancel)
        signals = stack.enter_context(_seen_signals())
        try:
            with _deadline(limit):
                yield
        except _TimeIsUp as error:
            problem = f"it takes longer than {limit:g} s ({TIMEOUT_VARIABLE} sets another limit)"
            raise PluginError(plugin, f"{who} {doing}: {problem}.") from error
        except BaseException as error:
            if signal.SIGINT in signals and isinstance(error, Exception):
                raise KeyboardInterrupt from error  # an import may turn it into any other error
            if signals:
                raise
            text = f"{who} {doing}: {_description(error)}"
            # Libraries such as torch read all metadata when they are imported.
            hints = [*(unmet_requirements(package) if package else []), unreadable_hint()]
            hint = " ".join(filter(None, hints))
            raise PluginError(plugin, f"{text.rstrip('.')}. {hint}" if hint else text) from error


def _timeout() -> float:
    with contextlib.suppress(ValueError):
        return max(0.01, float(os.environ.get(TIMEOUT_VARIABLE, TIMEOUT)))
    return TIMEOUT


def _note(text: str) -> None:
    print(printable(text), file=sys.stderr, flush=True)  # noqa: T201 - nothing else runs


def _description(error: BaseException) -> str:
    if isinstance(error, SystemExit):
        return f"it calls sys.exit({error.code!r})"
    frames = traceback.extract_tb(error.__traceback__)
    files = [Path(each.filename) for each in frames]
    own = [
        f"({file.name}, line {frame.lineno})"
        for file, frame in zip(files, frames, strict=True)
        if file.is_file() and file.parent != Path(__file__).parent and "importlib" not in file.parts
    ]
    says_all = isinstance(error, (ImportError, SyntaxError, PhysxError))
    if str(error) and (says_all or not own):
        return str(error)
    text = f": {error}" if str(error) else ""
    return " ".join([f"{type(error).__name__}{text}", *own[-1:]])


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def _seen_signals() -> Iterator[list[int]]:
    """Yield a list that collects the numbers of signals arriving within the context."""
    seen: list[int] = []
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM) if _is_main() else ():
            before = signal.getsignal(number)
            if callable(before):
                stack.enter_context(_handled(number, _noting(seen, before)))
        yield seen


def _noting(seen: list[int], before: Any) -> Any:
    def handle(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        before(number, frame)

    return handle


@contextlib.contextmanager
def _handled(number: signal.Signals, handle: Any) -> Iterator[None]:
    """Handle a signal within the context; a handler that a plugin sets itself stays."""
    before = signal.signal(number, handle)
    try:
        yield
    finally:
        if signal.getsignal(number) is handle:
            signal.signal(number, before)


@contextlib.contextmanager
def _deadline(limit: float) -> Iterator[None]:
    """Raise `_TimeIsUp` after `limit` s, unless the alarm timer is already in use."""
    is_free = _is_main() and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    if not is_free or signal.getitimer(signal.ITIMER_REAL)[0]:
        yield
        return
    is_over = False

    def ring(number: int, frame: FrameType | None) -> None:
        if not is_over:
            raise _TimeIsUp

    with _handled(signal.SIGALRM, ring):
        signal.setitimer(signal.ITIMER_REAL, limit, 1.0)  # repeat in case the first is swallowed
        try:
            yield
        finally:
            is_over = True
            signal.setitimer(signal.ITIMER_REAL, 0.0)
