"""Warnings in clients, which the run repeats when they end."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

from physx_core.components.launcher import ClientHandle

_MARK = "physx client warned: "
_CORE = Path(__file__).parents[1]


def mark_warnings() -> None:
    """Write this process's warnings so that `repeat_warnings` finds them: in a line each."""
    warnings.formatwarning = _marked


def _marked(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    kind = "" if category is UserWarning else f"{category.__name__}: "
    file = Path(filename)
    place = "" if _CORE in file.parents else f" ({file.name}:{lineno})"
    return f"{_MARK}{kind}{' '.join(str(message).split())}{place}\n"


def repeat_warnings(handles: Iterable[ClientHandle]) -> None:
    """Warn of what clients warned of in the last lines of their standard error, each once."""
    found: dict[str, int] = {}
    for handle in handles:
        for line in handle.stderr().splitlines():
            if line.startswith(_MARK):
                found.setdefault(line.removeprefix(_MARK), handle.instance_id)
    for text, number in found.items():
        warnings.warn(f"Client {number} warned: {text}", stacklevel=2)
