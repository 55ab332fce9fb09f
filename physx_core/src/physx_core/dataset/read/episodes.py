"""Finds the trajectories of a mode by the fields that physx adds to each row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.read.order.records import RecordedEpisodes
from physx_core.dataset.store.episode_record import EpisodeStatus
from physx_core.errors import DatasetError
from physx_core.typing import Batch, Index

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Episode:
    """Rows that follow one another in time.

    Attributes:
        env_id: Instance that generated them, counted from 1; 0 for an independent episode.
        episode: Number of the trajectory within the instance, counted from 0. It is not unique:
            every run starts counting again, and a trajectory with a missing sample becomes two.
            That of an independent episode is unique in its campaign.
        rows: Numbers of the rows in their mode, in temporal order.
        campaign: Number of the campaign of an independent episode, counted from 0.
    """

    env_id: int
    episode: int
    rows: Index
    campaign: int = 0


class Trajectories(NamedTuple):
    """The trajectories of a mode, in the order of their first rows; columns of shape (n,).

    Attributes:
        campaign: Number of the campaign of an independent episode; -1 for a part of a stream.
        episode: Number of the independent episode in its campaign; of parts of streams, their
            number in this order, which never changes as rows are added.
        start: Place of the first row in `places`.
        rows: Number of rows.
        places: Row numbers by place, shape (rows of the mode,); None: they are the places.
    """

    campaign: Index
    episode: Index
    start: Index
    rows: Index
    places: Index | None

    @property
    def first_rows(self) -> Index:
        """The row with which each begins."""
        return self.start if self.places is None else self.places[self.start]

    def take(self, chosen: Index | Flags) -> Trajectories:
        """Return some of the trajectories."""
        campaign, number, start, rows = (column[chosen] for column in self[:4])
        return Trajectories(campaign, number, start, rows, self.places)


def find_trajectories(known: ModeRows) -> Trajectories:
    """Return the trajectories among rows of a mode.

    A trajectory is an independent episode, which is found without reading a row; of other rows it
    is a maximal sequence of rows of one instance, in the order of writing, with the same number in
    ``episode`` and consecutive steps.

    Args:
        known: The rows; if ``env_id`` or ``episode`` is missing, it is taken as equal in all.

    Raises:
        DatasetError: If other rows have neither ``step`` nor ``episode``.
    """
    if known.order is None:
        return _of_streams(known, [(0, known.count)])
    found, total = known.order.episodes, known.count
    is_stream = found.status == EpisodeStatus.STREAM
    independent = _of_records(found, total, ~is_stream)
    inside = is_stream & (found.rows > 0) & (found.first < total)
    if not inside.any():
        return independent
    first, stop = found.first[inside], np.minimum((found.first + found.rows)[inside], total)
    streams = _of_streams(known, list(zip(first.tolist(), stop.tolist(), strict=True)))
    campaign, episode, start, rows = map(
        np.concatenate, zip(streams[:4], independent[:4], strict=True)
    )
    both = Trajectories(campaign, episode, start, rows, streams.places)
    return both.take(np.argsort(both.first_rows, kind="stable"))


def find_episodes(known: ModeRows) -> list[Episode]:
    """Return the trajectories as a list, with the rows of each: see `find_trajectories`."""
    found = find_trajectories(known)
    instance, number = _named(known, found, "env_id"), _named(known, found, "episode")
    number = np.where(found.campaign < 0, number, found.episode)
    places = np.arange(known.count) if found.places is None else found.places
    columns = (instance, number, found.start, found.rows, np.maximum(found.campaign, 0))
    return [
        Episode(env_id, episode, places[start : start + rows], campaign)
        for env_id, episode, start, rows, campaign in zip(
            *(column.tolist() for column in columns), strict=True
        )
    ]


def episode_lengths(known: ModeRows) -> tuple[Index, int]:
    """Return the number of rows of each trajectory and the number of instances.

    Arguments and errors are those of `find_trajectories`.
    """
    found = find_trajectories(known)
    return found.rows, len(np.unique(_named(known, found, "env_id")))


def _named(known: ModeRows, found: Trajectories, name: str) -> Index:
    """Return the value of a field in the first row of trajectories in streams; 0 of others."""
    values = np.zeros(len(found.rows), np.int64)
    streams = found.campaign < 0
    if name in known.fields and streams.any():
        values[streams] = known.gather(name, found.first_rows[streams])
    return values


def _of_records(found: RecordedEpisodes, total: int, chosen: Flags) -> Trajectories:
    """Return independent episodes among the first `total` rows."""
    has_rows = chosen & (found.rows > 0) & (found.first < total)
    each = np.where(found.numbers > 1, found.rows, 1)[has_rows]
    entry = np.repeat(np.flatnonzero(has_rows), each)
    place = np.arange(len(entry)) - np.repeat(np.cumsum(each) - each, each)
    rows = np.where(found.numbers[entry] > 1, 1, found.rows[entry])
    start = found.first[entry] + place
    inside = start < total
    entry, start, rows = entry[inside], start[inside], rows[inside]
    number = found.episode[entry] + place[inside]
    rows = np.minimum(rows, total - start)
    return Trajectories(found.campaign[entry], number, start, rows, None)


def _of_streams(known: ModeRows, spans: Sequence[tuple[int, int]]) -> Trajectories:
    """Return the trajectories among rows of streams, each of them from a first to a last row."""
    starts, rows, places = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)], None
    for first, stop in spans:
        begins, order = _cut(known, first, stop)
        starts.append(begins)
        rows.append(np.diff(begins, append=stop))
        if order is not None:
            places = np.arange(known.count) if places is None else places
            places[first:stop] = order
    none = np.full(sum(map(len, starts)), -1)
    found = Trajectories(none, none, np.concatenate(starts), np.concatenate(rows), places)
    found = found.take(np.argsort(found.first_rows, kind="stable"))
    return found._replace(episode=np.arange(len(none)))


def _cut(known: ModeRows, first: int, stop: int) -> tuple[Index, Index | None]:
    """Cut the rows of a stream into trajectories.

    Returns:
        Where they begin among the rows by instance, counted from the first row of the mode, and
        the numbers of these rows; None if they are of one instance.
    """
    names = [name for name in ("env_id", "episode", "step") if name in known.fields]
    if names in ([], ["env_id"]):
        raise DatasetError(
            'The rows have no fields "step" and "episode", so it is unknown where trajectories '
            "begin. Samples generated by environments have these fields."
        )
    begins: list[Index] = [np.zeros(0, np.intp)]
    before: dict[str, Any] = dict.fromkeys(names, -2)
    for start, block in known.blocks(names, first, stop):
        if "env_id" in block and start == first:
            instance = block["env_id"][0]
        if "env_id" in block and (block["env_id"] != instance).any():
            return _cut_interleaved(known, names, first, stop)
        begins.append(start + np.flatnonzero(_begins(block, before)))
        before = {name: values[-1] for name, values in block.items()}
    found = np.concatenate(begins)
    if first < stop and not (len(found) and found[0] == first):
        found = np.append(first, found)
    return found, None


def _cut_interleaved(
    known: ModeRows, names: Sequence[str], first: int, stop: int
) -> tuple[Index, Index]:
    """Cut rows of several instances: see `_cut`."""
    rows = {name: np.empty(stop - first, known.fields[name].numpy_dtype) for name in names}
    for start, block in known.blocks(names, first, stop):
        for name, values in block.items():
            rows[name][start - first :][: len(values)] = values
    instance = rows["env_id"]
    if instance.min() >= 0 and instance.max() < 2**16:
        instance = instance.astype(np.uint16)  # which is sorted in linear time
    order = np.argsort(instance, kind="stable")
    new = _begins({name: values[order] for name, values in rows.items()}, {})
    new[0] = True
    return first + np.flatnonzero(new), first + order


def _begins(rows: Batch, before: Mapping[str, Any]) -> Flags:
    """Return which rows begin a trajectory, given the values in the row before the first one."""
    new = np.zeros(len(next(iter(rows.values()))), bool)
    for name, values in rows.items():
        step = int(name == "step")
        new[1:] |= np.diff(values) != step if step else values[1:] != values[:-1]
        new[0] |= name in before and values[0] != before[name] + step
    return new
