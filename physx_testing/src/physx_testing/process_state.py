"""The state of a process, such as signal handlers and locale, which components must not change."""

from __future__ import annotations

import contextlib
import locale
import os
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from physx_core.processes import children

_VARIABLES = "the environment variables"
_LASTING = (
    "the working directory",
    "the folder of temporary files",
    "the umask",
    "the signal handlers",
    "the locale",
    "sys.excepthook",
)
"""What is compared with the state before the component was imported."""
_PATIENCE = 5.0
"""Seconds within which ended threads and processes must be gone."""


def process_state() -> dict[str, Any]:
    """Return process-wide state, by its name in messages."""
    mask = os.umask(0o077)
    os.umask(mask)
    name, keys, place, *gauss = np.random.get_state(legacy=True)  # noqa: NPY002 - to see changes
    return {
        "the working directory": _working_directory(),
        _VARIABLES: dict(os.environ),
        "the folder of temporary files": tempfile.tempdir,
        "the umask": mask,
        "the signal handlers": {
            number.name: signal.getsignal(number)
            for number in sorted(signal.valid_signals())
            if isinstance(number, signal.Signals)
        },
        "the state of NumPy's global random numbers": (
            name,
            np.asarray(keys).tobytes(),
            place,
            gauss,
        ),
        "the state of Python's global random numbers": _python_random(),
        "NumPy's handling of floating-point errors": np.geterr(),
        "NumPy's print options": np.get_printoptions(),
        "the locale": locale.setlocale(locale.LC_ALL),
        "the warning filters": list(warnings.filters),
        "the recursion limit": sys.getrecursionlimit(),
        "sys.excepthook": sys.excepthook,
        "standard output": sys.stdout,
        "standard error": sys.stderr,
    }


@contextlib.contextmanager
def unchanged(before: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Check that the code in this context leaves the process unchanged.

    Args:
        before: The state before the component was imported, to compare the working directory and
            the like with; None: the state on entry.

    Raises:
        AssertionError: If something has changed, or a thread or child process is left.
    """
    kept = process_state()
    if before is not None:
        kept |= {what: before[what] for what in _LASTING}
        kept[_VARIABLES] |= before[_VARIABLES]  # libraries add some of their own
    threads, processes = set(threading.enumerate()), children()
    yield
    found = [
        f"it changed {what}{_difference(kept[what], value)}"
        for what, value in process_state().items()
        if value != kept[what]
    ]
    found += _left(lambda: [each.name for each in set(threading.enumerate()) - threads], "threads")
    found += _left(lambda: sorted(children() - processes), "child processes")
    if found:
        raise AssertionError("; ".join(found))


def _left(find: Callable[[], list[Any]], what: str) -> list[str]:
    """Wait until nothing is left; return a message about what remains."""
    until = time.monotonic() + _PATIENCE
    while found := find():
        if time.monotonic() > until:
            return [f"{what} are left: {found}"]
        time.sleep(0.02)
    return []


def _working_directory() -> str:
    try:
        return str(os.getcwd())  # noqa: PTH109 - a string, for comparison
    except FileNotFoundError:
        return "(removed)"


def _python_random() -> Any:
    import random

    return random.getstate()


def _difference(before: Any, after: Any) -> str:
    if isinstance(before, str | int | None):
        return f": {before!r} became {after!r}"
    if isinstance(before, dict):
        names = [key for key in {**before, **after} if before.get(key) != after.get(key)]
        return f": {', '.join(map(str, names[:5]))}"
    return ""
