"""Proof: an episode that has finished is simulated again, and must have the same rows."""

from __future__ import annotations

import numpy as np

from physx_core.components.hand import HAND
from physx_core.dataset import Dataset, EpisodeStatus
from physx_core.errors import DependentEpisodeError
from physx_core.sources.episode_source import EpisodeSource
from physx_core.typing import Array, Batch
from physx_core.workers.episode_runner import EpisodeBlock

_SHARE = 0.01  # of the cost of all episodes


class IndependenceProof:
    """Remembers the cheapest episode of a run, and simulates it again at the end.

    That happens only if it costs less than 1 % of what all episodes of the run have cost.
    """

    def __init__(self) -> None:
        """Know no episode yet."""
        self._total = 0.0
        self._cheapest: tuple[float, int, int] | None = None  # s, number, instance

    def note(self, block: EpisodeBlock) -> None:
        """Note what episodes have cost."""
        for record in block.records:
            self._total += record.seconds
            is_whole = record.status is EpisodeStatus.FINISHED and not record.part and record.rows
            if is_whole:
                found = record.seconds / record.count, record.episode, block.instance_id
                self._cheapest = found if self._cheapest is None else min(self._cheapest, found)

    def check(self, source: EpisodeSource, dataset: Dataset, mode: str, campaign: int) -> None:
        """Simulate an episode again and compare its rows with the stored ones.

        Raises:
            DependentEpisodeError: If they differ.
        """
        if self._cheapest is None or self._cheapest[0] > _SHARE * self._total:
            return
        if HAND in dataset[mode]:  # people do not do the same again
            return
        _, number, instance_id = self._cheapest
        rows = source.repeat(number, instance_id)
        compare(number, _stored(dataset, mode, campaign, number), rows)


def compare(number: int, stored: Batch, again: Batch) -> None:
    """Compare the rows of an episode bit by bit.

    Raises:
        DependentEpisodeError: If they differ.
    """
    for name, values in stored.items():
        count = len(again.get(name, ()))
        if count != len(values):
            what = f"had {count} rows instead of {len(values)}"
            raise DependentEpisodeError(number, "", min(count, len(values)), _explain(number, what))
        if values.dtype.hasobject:
            _compare_free(number, name, values, again[name])
            continue
        before, after = values.reshape(count, -1), again[name].reshape(count, -1)
        differs = (_bytes_of(before) != _bytes_of(after)).reshape(*before.shape, -1).any(2)
        if differs.any():
            row, place = np.argwhere(differs)[0].tolist()
            first, other = before[row, place].item(), after[row, place].item()
            what = f'had another "{name}" in row {row}: {other!r} instead of {first!r}'
            raise DependentEpisodeError(number, name, row, _explain(number, what))


def _compare_free(number: int, name: str, stored: Array, again: Array) -> None:
    """Compare rows of a field with a free axis bit by bit."""
    for row, (before, after) in enumerate(zip(stored, again, strict=True)):
        if before.shape != after.shape or before.tobytes() != np.asarray(after).tobytes():
            what = f'had another "{name}" in row {row}'
            raise DependentEpisodeError(number, name, row, _explain(number, what))


def _bytes_of(values: Array) -> Array:
    return np.ascontiguousarray(values).view(np.uint8)


def _explain(number: int, what: str) -> str:
    return (
        f"Episode {number} {what} when it was simulated again, so episodes are not independent: "
        "what an earlier one left, the client, or the time has an influence. Set the complete "
        "state in reset_parameters(), and take random numbers from self.rng only. If the solver "
        "itself is not reproducible to the last bit, set prove_independence=False. All samples are "
        "stored."
    )


def _stored(dataset: Dataset, mode: str, campaign: int, number: int) -> Batch:
    """Return the stored rows of an episode, and what it has once: see `EpisodeSource.repeat`."""
    known = dataset.recorded_episodes(mode)
    assert known is not None
    own = (known.campaign == campaign) & (known.episode <= number)
    (place,) = np.flatnonzero(own & (number < known.episode + known.numbers)).tolist()
    several = known.numbers[place] > 1
    first = int(known.first[place] + (number - known.episode[place] if several else 0))
    end = first + (1 if several else int(known.rows[place]))
    data = dataset[mode]
    once = {name: dataset.episode_values(mode, name, first) for name in dataset.episode_fields}
    return {name: data[name][first:end] for name in data} | once
