"""Interval and length of learning-rate schedules, found by inspecting the scheduler."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

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


class TrainingLength(NamedTuple):
    """Length of a training, and how often its scheduler is stepped in it.

    Attributes:
        epochs: Number of epochs.
        batches: Number of batches in an epoch.
        every: Number of batches between the scheduler's steps; None: it is stepped every epoch.
    """

    epochs: int
    batches: int
    every: int | None

    @property
    def steps(self) -> int:
        """Number of the scheduler's steps."""
        return self.epochs if self.every is None else self.epochs * self.batches // self.every

    def describe(self, scheduler: LRScheduler) -> str:
        """Return when the scheduler is stepped, and if its schedule is longer than the training."""
        every = "epoch" if self.every is None else "batch"
        if self.every is not None and self.every > 1:
            every = f"{self.every} batches"
        length = _schedule_length(scheduler)
        part = f": {self.steps} of its {length} steps" if self.steps < (length or 0) else ""
        return f"learning rate: {type(scheduler).__name__}, stepped every {every}{part}"

    def check(self, scheduler: LRScheduler) -> None:
        """Check that the schedule does not end before the training.

        Raises:
            ConfigError: If it does.
        """
        if not isinstance(scheduler, OneCycleLR) or self.steps <= scheduler.total_steps:
            return
        each = "" if self.every is None else f" of {self.batches} batches"
        raise ConfigError(
            f"OneCycleLR's schedule has {scheduler.total_steps} steps, but the training takes "
            f"{self.steps}: {self.epochs} epochs{each}. Set total_steps={self.steps} "
            f"(--network.scheduler-kwargs total_steps={self.steps}). A resumed training keeps its "
            "schedule: start another one from its network (NetworkConfig.network_dir)."
        )


def _schedule_length(scheduler: LRScheduler) -> int | None:
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
