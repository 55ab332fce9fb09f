"""An environment one of whose methods ends in a way that is not an error."""

from __future__ import annotations

import asyncio
import os
import sys

from physx_core.toy import Spring


class OwnEnding(BaseException):
    """An ending of the user's own."""


WAYS = {
    "sys.exit(0)": lambda: sys.exit(0),
    "sys.exit()": lambda: sys.exit(),
    "sys.exit(1)": lambda: sys.exit(1),
    "sys.exit(text)": lambda: sys.exit("no license"),
    "KeyboardInterrupt": lambda: _raise(KeyboardInterrupt()),
    "GeneratorExit": lambda: _raise(GeneratorExit()),
    "CancelledError": lambda: _raise(asyncio.CancelledError()),
    "StopIteration": lambda: _raise(StopIteration()),
    "own": lambda: _raise(OwnEnding()),
    "os._exit(0)": lambda: os._exit(0),
}
"""Ways in which code can end; the last one can only be noticed from another process."""


def _raise(error):
    raise error


def ending(base, method, way):
    """A subclass one of whose methods ends in one of the ways when it has run twice."""
    original, calls = getattr(base, method), []

    def ends(self, *arguments, **kwargs):
        calls.append(None)
        if len(calls) == (3 if method in ("step", "check_sample", "apply_prediction") else 1):
            WAYS[way]()
        return original(self, *arguments, **kwargs)

    return type("Own", (base,), {method: ends})


def client(method, way, **kwargs):
    """The environment of a client."""
    return ending(Spring, method, way)(**kwargs)
