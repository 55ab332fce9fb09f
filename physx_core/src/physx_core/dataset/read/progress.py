"""Counts the finished, failed, cut and unfinished episodes of each campaign of a mode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from physx_core.dataset.read.order.records import Found, Records
from physx_core.dataset.store.episode_record import EpisodeStatus
from physx_core.typing import Array, Index


class Progress(NamedTuple):
    """How many episodes of a campaign have ended, and how.

    Attributes:
        campaign: Number of the campaign.
        finished: Number of episodes that are finished.
        failed: Number of episodes that have failed.
        cut: Number of episodes that were ended before their own end.
        unfinished: Number of episodes of which some parts are stored, but not the last one.
        seconds: What the finished, failed and cut ones have cost, in s.
    """

    campaign: int
    finished: int
    failed: int
    cut: int
    unfinished: int
    seconds: float

    @property
    def ended(self) -> int:
        """Number of episodes that are finished, failed or cut."""
        return self.finished + self.failed + self.cut

    @property
    def mean(self) -> float:
        """What an episode has cost, in s; 0 if none has ended."""
        return self.seconds / max(self.ended, 1)


def find_progress(found: Found, records: Records, seconds: Array) -> list[Progress]:
    """Return the progress of each campaign, in order.

    Args:
        found: All episodes that count.
        records: The records about the mode, in the order of writing.
        seconds: What each of them has cost, in s, shape (records,).
    """
    episodes = np.repeat(np.arange(len(found.parts)), found.parts)
    spent = np.bincount(episodes, seconds[found.record], len(found.parts))
    cost = spent * (found.numbers / records.numbers[found.last])
    is_open = _unfinished(records)
    progress = []
    for campaign in np.unique(records.campaign[records.episode >= 0]).tolist():
        chosen = (found.campaign == campaign) & (found.episode >= 0)
        finished, failed, cut = (
            int(found.numbers[chosen & (found.status == status)].sum())
            for status in (EpisodeStatus.FINISHED, EpisodeStatus.FAILED, EpisodeStatus.CUT)
        )
        unfinished = int((records.campaign[is_open] == campaign).sum())
        total = float(cost[chosen].sum())
        progress.append(Progress(campaign, finished, failed, cut, unfinished, total))
    return progress


def _unfinished(records: Records) -> Index:
    """Return the last record of each episode that has not ended."""
    order = np.lexsort((records.episode, records.campaign))
    same = (np.diff(records.campaign[order]) == 0) & (np.diff(records.episode[order]) == 0)
    last = order[np.append(~same, True)] if len(order) else order
    found: Index = last[records.status[last] == EpisodeStatus.MORE]
    return found
