"""Finds the sets of parameters that stored rows were generated with."""

from __future__ import annotations

import numpy as np

from physx_core.components.parameter import SET_FIELDS
from physx_core.config import MODES, SETS
from physx_core.dataset import (
    EPISODES,
    TABLE_FIELDS,
    Dataset,
    EpisodeStatus,
    RecordedEpisodes,
)
from physx_core.errors import DatasetError
from physx_core.typing import Array, Batch, Index
from physx_core.workers.instance import PARAMETER, SET

_CHUNK = 1 << 20
_FIRST = 1  # the instance that generates the first row and begins the first set of each run


class StoredSets:
    """Finds the set of each row by its instance and episode, which restart with each run.

    The runs that added rows to a mode are those that added sets for it, in the same order.
    """

    def __init__(self, dataset: Dataset, mode: str) -> None:
        """Read the record of the sets.

        Args:
            dataset: Contains the rows, and the record in the mode "parameters".
            mode: The rows' mode.

        Raises:
            DatasetError: If the runs of rows and sets do not match.
        """
        view = dataset[SETS]
        places = np.flatnonzero(view["mode_index"][:] == MODES.index(mode))
        record = {name: view[name][:][places] for name in dataset.fields(SETS)}
        env_id, episode = record["env_id"], record["episode"]
        runs = _runs(np.flatnonzero(env_id == _FIRST), episode, len(places))
        known, self._starts = runs >= 0, _first_rows(dataset, mode)
        if len(self._starts) != (count := runs.max(initial=-1) + 1):
            raise DatasetError(
                f'The samples of mode "{mode}" in {dataset.directory} come from '
                f"{len(self._starts)} runs, but their recorded parameters from {count}, "
                "so each sample's parameters are unknown. Generate them again."
            )
        self._values = {name: record[name] for name in record if name not in _OWN}
        self._base = int(env_id.max(initial=0)) + 1, int(episode.max(initial=0)) + 1
        keys = self._keys(runs, episode, env_id)
        keys[~known] = -1
        self._known, self._places = np.unique(keys, return_index=True)

    def of(self, index: Index, rows: Batch) -> Batch:
        """Return the parameters of some rows, as the batch entries that `Instance.step` reads.

        Args:
            index: Their indices in the mode.
            rows: The rows.
        """
        runs = np.searchsorted(self._starts, index, "right") - 1
        keys = self._keys(runs, rows["episode"], rows["env_id"])
        keys[(rows["episode"] >= self._base[1]) | (rows["env_id"] >= self._base[0])] = -2
        found = np.minimum(np.searchsorted(self._known, keys), len(self._known) - 1)
        places = self._places[found]
        values = {PARAMETER + name: values[places] for name, values in self._values.items()}
        return {SET: np.where(self._known[found] == keys, places, -1), **values}

    def _keys(self, runs: Index, episode: Array, env_id: Array) -> Index:
        return (runs * self._base[1] + episode.astype(np.int64)) * self._base[0] + env_id


_OWN = {field.name for field in SET_FIELDS}


class RecordedSets:
    """Finds the set of each row of an independent episode in the table of episodes."""

    def __init__(self, dataset: Dataset, mode: str, episodes: RecordedEpisodes) -> None:
        """Read the parameters.

        Args:
            dataset: Contains the rows and the table.
            mode: The rows' mode.
            episodes: The episodes of this mode.
        """
        view = dataset[EPISODES]
        self._episodes = episodes
        self._values = {name: view[name][:] for name in _parameters(dataset)}
        stream = view["status"][:] == EpisodeStatus.STREAM
        places = np.flatnonzero((view["mode_index"][:] == MODES.index(mode)) & ~stream)[::-1]
        campaign, episode = (view[name][:][places] for name in ("campaign", "episode"))
        self._base = int(episode.max(initial=0)) + 1
        self._known, newest = np.unique(campaign * self._base + episode, return_index=True)
        self._places = places[newest]

    def of(self, index: Index, rows: Batch) -> Batch:
        """Return the parameters of some rows: see `StoredSets.of`."""
        known = self._episodes
        entry = np.searchsorted(known.first, index, "right") - 1
        keys = known.campaign[entry] * self._base + known.episode[entry]
        found = np.minimum(np.searchsorted(self._known, keys), len(self._known) - 1)
        places = self._places[found]
        is_known = (self._known[found] == keys) & (known.status[entry] != EpisodeStatus.STREAM)
        values = {PARAMETER + name: values[places] for name, values in self._values.items()}
        return {SET: np.where(is_known, places, -1), **values}


def find_sets(dataset: Dataset, mode: str) -> StoredSets | RecordedSets | None:
    """Return what finds the parameters of a mode's rows; None if a dataset records none."""
    if mode not in MODES:
        return None
    episodes = dataset.recorded_episodes(mode)
    if episodes is not None:
        return RecordedSets(dataset, mode, episodes) if _parameters(dataset) else None
    if not dataset.num_samples(SETS):
        return None
    is_about = dataset[SETS]["mode_index"][:] == MODES.index(mode)
    return StoredSets(dataset, mode) if is_about.any() else None


def _parameters(dataset: Dataset) -> list[str]:
    """Return the names of the parameters in the table of episodes."""
    others = {field.name for field in TABLE_FIELDS} | dataset.episode_fields.keys()
    return [name for name in dataset.fields(EPISODES) if name not in others]


def _runs(first: Index, order: Array, count: int) -> Index:
    """Return the run of each entry, from 0; -1 before the first one.

    Args:
        first: Indices of the entries of the first instance.
        order: A number for each entry; it increases within a run for each instance.
        count: Number of entries.
    """
    begins = np.zeros(count, bool)
    begins[first[:1]] = True
    begins[first[1:]] = np.diff(order[first]) <= 0
    runs: Index = np.cumsum(begins) - 1
    return runs


def _first_rows(dataset: Dataset, mode: str) -> Index:
    """Return the index of the first row of each run."""
    view, total = dataset[mode], dataset.num_samples(mode)
    starts: list[Index] = []
    last = np.iinfo(np.int64).max
    for start in range(0, total, _CHUNK):
        part = slice(start, min(start + _CHUNK, total))
        rows = np.flatnonzero(view["env_id"][part] == _FIRST)
        steps = view["step"][part][rows].astype(np.int64)
        starts.append(start + rows[np.diff(steps, prepend=last) <= 0])
        last = steps[-1] if len(steps) else last
    return np.concatenate(starts) if starts else np.zeros(0, np.intp)
