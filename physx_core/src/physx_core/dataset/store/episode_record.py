"""EpisodeRecord: what becomes of an episode; it says so without reading or writing a dataset.

A client needs nothing else of datasets, and not what they are made with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from physx_core.checks import store_declared
from physx_core.errors import ConfigError

OPEN = 2**60
"""Number of rows of a stream that is being written."""


class EpisodeStatus(IntEnum):
    """What a record says about an episode."""

    FINISHED = 0
    FAILED = 1
    """It has no rows."""
    CUT = 2
    """It was ended before its own end; its rows count."""
    MORE = 3
    """Further parts follow."""
    STREAM = 4
    """Its rows are a stream's; only the dataset writes such records."""


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """What is recorded of an episode, or of a range of them, with rows that are stored at once.

    Attributes:
        episode: Its number in the campaign, counted from 0; the first one of a range.
        rows: How many of the rows are its own.
        campaign: Number of the campaign in the mode, counted from 0.
        count: Number of episodes, of one row each, in order.
        part: Which part of the episode the rows are, counted from 0. Part 0 begins it anew; what
            was recorded before stays until the last part is recorded.
        status: ``FINISHED``, ``CUT``, ``FAILED`` (without rows), or ``MORE`` if parts follow.
        seconds: What it cost, in s.
        parameters: Values of the environment's parameters by name; of several episodes, arrays
            with one more axis, the first, which has one entry for each.
        fields: Values by name of the fields that an episode has once, in the record of its last
            part; of several episodes, and of one that has failed, none.
        reason: Why it failed.
    """

    episode: int
    rows: int
    campaign: int = 0
    count: int = 1
    part: int = 0
    status: EpisodeStatus = EpisodeStatus.FINISHED
    seconds: float = 0.0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""

    def __post_init__(self) -> None:
        """Check the values, and store the numbers as declared.

        Raises:
            ConfigError: If a number is of another type, or they contradict one another.
        """
        store_declared("EpisodeRecord.", self)
        least = min(self.episode, self.rows, self.campaign, self.part, self.count - 1)
        several = self.count == 1 or (
            self.rows == self.count
            and not (self.part or self.fields)
            and all(np.shape(each)[:1] == (self.count,) for each in self.parameters.values())
            and self.status is EpisodeStatus.FINISHED
        )
        failed = self.status is not EpisodeStatus.FAILED or not self.rows
        known = isinstance(self.status, EpisodeStatus) and self.status is not EpisodeStatus.STREAM
        most = max(self.episode + self.count, self.rows, self.campaign, self.part)
        if least < 0 or most >= OPEN or not (several and failed and known):
            raise ConfigError(f"There can be no such episode: {self}.")
