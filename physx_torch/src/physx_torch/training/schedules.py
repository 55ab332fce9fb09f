"""When a learning-rate scheduler is stepped, and how many steps its schedule has."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

from torch.optim.lr_scheduler import CyclicLR, LRScheduler, OneCycleLR, ReduceLROnPlateau

from physx_core.errors import ConfigError

_STEPS = re.compile("(^|_)steps(_|$)")
"""Matches arguments that count steps, such as ``total_steps`` and ``num_warmup_steps``."""
_LENGTHS = ("total_steps", "T_max", "total_iters")


def choose_interval(
    scheduler: LRScheduler, arguments: Iterable[str], asked: str | None = None
) -> str:
    """Return when to step a scheduler: ``"step"`` or ``"epoch"``.

    Unless asked otherwise, OneCycleLR, CyclicLR, and schedulers whose arguments are numbers of
    steps by name are stepped with the optimizer, also as parts of a composed schedule.

    Args:
        scheduler: The scheduler.
        arguments: Names of the arguments that it was made with.
        asked: What the user asked for, if anything.

    Raises:
        ConfigError: If the scheduler cannot be stepped as asked.
    """
    parts = list(_parts(scheduler))
    if any(isinstance(part, ReduceLROnPlateau) for part in parts):
        if asked == "step":
            raise ConfigError(
                'ReduceLROnPlateau compares the losses of epochs: scheduler_interval="step" is not '
                "possible. Leave it out."
            )
        return "epoch"
    counts = any(isinstance(part, (OneCycleLR, CyclicLR)) for part in parts)
    return asked or ("step" if counts or any(map(_STEPS.search, arguments)) else "epoch")


def schedule_length(scheduler: LRScheduler) -> int | None:
    """Return the number of steps of a schedule; None if it has none, or it is unknown."""
    sequence, first = [scheduler], 0
    while milestones := getattr(sequence[-1], "_milestones", None):
        first += int(milestones[-1])
        sequence.append(sequence[-1]._schedulers[-1])  # type: ignore[attr-defined]
    lengths = [getattr(sequence[-1], name, None) for name in _LENGTHS]
    found = [first + length for length in lengths if isinstance(length, int)]
    return found[0] if found else None


def _parts(scheduler: Any) -> Iterator[Any]:
    """Yield a scheduler and, if it is composed, its parts."""
    yield scheduler
    for part in getattr(scheduler, "_schedulers", ()):
        yield from _parts(part)
