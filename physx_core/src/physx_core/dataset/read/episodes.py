"""Finds the trajectories of a mode by the fields that physx adds to each row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.store.episode_record import EpisodeStatus
from physx_core.errors import DatasetError
from physx_core.typing import Array, Index

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

    def take(self, chosen: Index | Flags) -> Trajectories:
        """Return some of the trajectories."""
        campaign, number, start, rows = (column[chosen] for column in self[:4])
        return Trajectories(campaign, number, start, rows, self.places)


def find_trajectories(known: ModeRows) -> Trajectories:
    """Return the trajectories among rows of a mode: see `find_episodes`.

    Those of independent episodes are found without reading a row.
    """
    order, total = known.order, known.count
    if order is None or (order.episodes.status == EpisodeStatus.STREAM).any():
        columns, places, begins = _cut(known)
        rows = np.diff(begins, append=len(places))
        by_first = np.argsort(places[begins], kind="stable")
        begins, rows, first = begins[by_first], rows[by_first], places[begins[by_first]]
        streams = columns["stream"][first]
        number = np.where(streams, np.cumsum(streams) - 1, columns["episode"][first])
        campaign = np.where(streams, -1, columns["campaign"][first])
        is_plain = bool((np.diff(places) == 1).all())  # of one instance
        return Trajectories(campaign, number, begins, rows, None if is_plain else places)
    found = order.episodes
    has_rows = (found.rows > 0) & (found.first < total)
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


def find_episodes(known: ModeRows) -> list[Episode]:
    """Return the trajectories among rows of a mode.

    A trajectory is an independent episode; of other rows it is a maximal sequence of rows of one
    instance, in the order of writing, with the same number in ``episode`` and consecutive steps.

    Args:
        known: The rows; if ``env_id`` or ``episode`` is missing, it is taken as equal in all.

    Returns:
        The trajectories in the order of their first rows.
    """
    columns, order, begins = _cut(known)
    parts = np.split(order, begins[1:]) if known.count else []
    parts.sort(key=lambda rows: int(rows[0]))
    env_id, episode, campaign = (columns[name] for name in ("env_id", "episode", "campaign"))
    return [
        Episode(int(env_id[rows[0]]), int(episode[rows[0]]), rows, int(campaign[rows[0]]))
        for rows in parts
    ]


def episode_lengths(known: ModeRows) -> tuple[Index, int]:
    """Return the number of rows of each trajectory and the number of instances.

    Arguments and errors are those of `find_episodes`.
    """
    columns, order, begins = _cut(known)
    return np.diff(begins, append=len(order)), len(np.unique(columns["env_id"]))


def _cut(known: ModeRows) -> tuple[dict[str, Array], Index, Index]:
    """Return the columns, the rows by instance, and where trajectories begin among these."""
    columns = _columns(known)
    order = np.argsort(columns["env_id"], kind="stable")
    begins = np.zeros(known.count, bool)
    for name in ("env_id", "episode", "entry"):
        begins |= np.diff(columns[name][order], prepend=-1) != 0
    if "step" in columns:
        begins |= columns["stream"][order] & (np.diff(columns["step"][order], prepend=-2) != 1)
    begins[:1] = True
    return columns, order, np.flatnonzero(begins)


def _columns(known: ModeRows) -> dict[str, Array]:
    """Return what tells trajectories apart, by row.

    That is ``env_id``, ``episode``, ``campaign``, ``entry``, the number of the entry in the table
    of episodes, ``stream``, whether the row belongs to one, and ``step`` if there are steps.
    """
    names = [name for name in ("env_id", "episode", "step") if name in known.fields]
    columns: dict[str, Array] = {name: known.read(name) for name in names}
    found, stream = _recorded(known)
    if "step" not in columns and "episode" not in columns and (not found or stream.any()):
        raise DatasetError(
            'The rows have no fields "step" and "episode", so it is unknown where trajectories '
            "begin. Samples generated by environments have these fields."
        )
    for name in ("env_id", "episode", "campaign", "entry"):
        own = columns.get(name, np.zeros(known.count, np.int64))
        columns[name] = np.where(stream, own, found.get(name, 0))
    columns["entry"] = found.get("entry", columns["entry"])
    return columns | {"stream": stream}


def _recorded(known: ModeRows) -> tuple[dict[str, Array], Flags]:
    """Return what the table of episodes says about each row, and which rows belong to a stream."""
    order, total = known.order, known.count
    if order is None:
        return {}, np.ones(total, bool)
    found = order.episodes
    entry = np.repeat(np.arange(len(found.rows)), found.rows)[:total]
    place = np.arange(total) - found.first[entry]
    episode = found.episode[entry] + np.where(found.numbers[entry] > 1, place, 0)
    columns = {"episode": episode, "campaign": found.campaign[entry], "entry": entry}
    return columns, found.status[entry] == EpisodeStatus.STREAM
