"""physx plugins `dart` and `pinocchio`: simulations of robots, and environments with them.

The public names are imported when they are first used, so that finding the plugins does not import
an engine.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from physx_dart.arm import DartArm, PinocchioArm
    from physx_dart.dart_simulation import DartBackend
    from physx_dart.double_pendulum import DartDoublePendulum, PinocchioDoublePendulum
    from physx_dart.pinocchio_simulation import PinocchioBackend

__version__ = "0.1.0"

_HOMES = {
    "DartArm": "arm",
    "DartBackend": "dart_simulation",
    "DartDoublePendulum": "double_pendulum",
    "PinocchioArm": "arm",
    "PinocchioBackend": "pinocchio_simulation",
    "PinocchioDoublePendulum": "double_pendulum",
}

__all__ = [
    "DartArm",
    "DartBackend",
    "DartDoublePendulum",
    "PinocchioArm",
    "PinocchioBackend",
    "PinocchioDoublePendulum",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"physx_dart.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
