"""Source: the items of a view in one dataset, and the order in which each pass visits them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from physx_core.dataset import Dataset, EpisodeStatus, Snapshot, Trajectories
from physx_core.dataset.read.episodes import Flags, find_trajectories
from physx_core.dataset.read.shuffling import (
    ItemOrder,
    OrderName,
    choose_order,
    key_of,
    make_order,
)
from physx_core.errors import ConfigError, DatasetError
from physx_core.plugins.references import import_component
from physx_core.typing import Array, Index
from physx_core.views.folds import Part, choose_part
from physx_core.views.items import Items, Located
from physx_core.views.options import ViewOptions, Window

_BLOCK, _SAME_SIZE = 16, 4096
"""Rows held back together where nothing is known of episodes, and after how many they double."""
_NOUNS = {"episode": "episodes", "trajectory": "trajectories", "block": "blocks of rows"}
_SHOWN = 8
"""Largest number of values of a parameter that is shown."""
_STATUS = {"finished": EpisodeStatus.FINISHED, "cut": EpisodeStatus.CUT}


class Source:
    """One dataset of a view.

    Attributes:
        dataset: The dataset.
        rows: Its rows at the snapshot.
        items: The items of the part.
        trajectories: How many trajectories the part has, and how many there are.
        division: The same in words.
        is_whole: Whether the parts differ in trajectories, not only in pieces or blocks of them.
    """

    def __init__(
        self,
        view: ViewOptions,
        dataset: Dataset,
        mode: str,
        part: Part,
        snapshot: Snapshot | None,
        beside: Source | None = None,
    ) -> None:
        """Find the items.

        Args:
            view: The view.
            dataset: The dataset.
            mode: Mode of the rows.
            part: Which part of the trajectories.
            snapshot: The rows at some time; None: now.
            beside: Another part of the same rows, whose trajectories have been found.

        Raises:
            ConfigError: If the view cannot be had of these rows.
            DatasetError: If rows are missing.
        """
        self.dataset = dataset
        self.rows = dataset.rows(mode, snapshot)
        self._view, self._drawn = view, (-1, np.zeros(0, np.intp))
        self._weights: Array | None = None
        self._found: tuple[str, Trajectories] = (
            self._find(part) if beside is None else beside._found
        )
        noun, found = self._found
        named = self._chosen(found)
        chosen = choose_part(view, part, named)
        taken, known = self.trajectories = len(chosen.rows), len(found.rows)
        self.division = f"{taken} of {known} {_NOUNS[noun]}"
        if part in ("validation", "test") and len(named.rows) < view.folds:
            each = f"each of {taken} {_NOUNS[noun]}" if taken != 1 else f"the only {noun}"
            self.division = f"a piece of {each}"
        self.is_whole = noun != "block" and len(named.rows) >= view.folds
        self.items = Items(view, chosen)
        self.rows.loads = self.order == "exact"

    def _find(self, part: Part) -> tuple[str, Trajectories]:
        """Return the trajectories, or blocks of rows if nothing is known of any; first, which."""
        view, rows = self._view, self.rows
        divides = part != "all" and (view.hold_back or view.test_fold is not None)
        chooses = view.windows or view.stride > 1 or view.episodes or view.where or view.weights
        if not (divides or chooses):
            return "block", _blocks(np.zeros(min(1, rows.count), np.intp), rows.count)
        return self._seek(needed=bool(chooses))

    def _seek(self, *, needed: bool) -> tuple[str, Trajectories]:
        """Return the trajectories; if nothing is known of any, blocks of rows, unless `needed`."""
        rows = self.rows
        try:
            found = find_trajectories(rows)
        except DatasetError:
            if needed:
                raise
            return "block", _growing_blocks(rows.count)
        return "trajectory" if (found.campaign < 0).any() else "episode", found

    @cached_property
    def groups(self) -> Groups:
        """The trajectories that its rows belong to, sought now if they did not matter before."""
        noun, found = self._found
        if noun == "block" and len(found.rows) < 2:
            noun, found = self._seek(needed=False)
        return Groups(noun, found, self.rows.count)

    def groups_of(self, items: Index) -> Index:
        """Return the place in `groups` of the trajectory of each item, shape (items,)."""
        return self.groups.find(self.items.rows(items)[:, 0])

    def describe_group(self, place: int) -> dict[str, Any]:
        """Return number, rows and parameters of a trajectory of `groups`."""
        found = self.groups.found
        first = found.first_rows[place : place + 1]
        known: dict[str, Any] = {
            "number": int(found.episode[place]),
            "first_row": int(first[0]),
            "rows": int(found.rows[place]),
        }
        if found.campaign[place] >= 0 and self.rows.order is not None:
            known["campaign"] = int(found.campaign[place])
            values = {name: self.rows.episode_values(name, first)[0]
                      for name in self.rows.episode_names}  # fmt: skip
            known["parameters"] = {
                name: value.tolist() for name, value in values.items() if value.size <= _SHOWN
            }
        return known

    def _chosen(self, found: Trajectories) -> Trajectories:
        """Return the trajectories that the view names."""
        view = self._view
        if not (view.episodes or view.where):
            return found
        if self.rows.order is None or (found.campaign < 0).any():
            raise ConfigError(
                f"View.episodes and View.where choose independent episodes, but the rows of "
                f"{self.dataset.directory} are not recorded as such."
            )
        keeps = np.ones(len(found.rows), bool)
        for name, given in view.episodes.items():
            if name == "status":
                keeps &= self._status(found) == _STATUS[given]
            else:
                values = found.episode if name == "episode" else self._values(name, found)
                keeps &= _inside(name, values, *given)
        if view.where is not None:
            keeps &= self._call(view.where, found)
        return found.take(keeps)

    def _status(self, found: Trajectories) -> Index:
        assert self.rows.order is not None
        known = self.rows.order.episodes
        return known.status[known.first.searchsorted(found.start, "right") - 1]

    def _values(self, name: str, found: Trajectories) -> Array:
        return self.rows.episode_values(name, found.start)

    def _call(self, reference: str, found: Trajectories) -> Flags:
        choose = import_component("function", reference)
        names = self.rows.episode_names
        given = {"episode": found.episode, "campaign": found.campaign, "rows": found.rows}
        kept = np.asarray(choose(given | {name: self._values(name, found) for name in names}))
        if kept.dtype != bool or kept.shape != found.rows.shape:
            raise ConfigError(
                f"View.where: {reference} returned {kept.dtype} of shape {kept.shape} for "
                f"{len(found.rows)} episodes, not one boolean for each."
            )
        return kept

    @property
    def num_samples(self) -> int:
        """Number of rows that the mode has now."""
        return self.dataset.num_samples(self.rows.mode)

    @property
    def count(self) -> int:
        """Number of items of a pass."""
        return self.items.count

    @property
    def order(self) -> OrderName:
        """The order of a pass."""
        given: Any = self._view.order
        found: OrderName = given or choose_order(self.count, self.rows.row_nbytes)
        return found

    def pass_order(self, key: int) -> ItemOrder:
        """Return the order of a pass."""
        return make_order(self.order, self.count, self.rows.row_nbytes, key)

    def drawn(self, items: Index, key: int) -> Index:
        """Return the items that a pass draws in place of some, if they have weights.

        Of the sorted weights of all items, places at equal distances are taken, from a random one
        on: so an item of weight w, of n items of mean weight 1, comes w times, rounded up or down.
        """
        if self._view.weights is None:
            return items
        if self._drawn[0] != key:
            ends = np.cumsum(self._weight())
            begin = key_of(key, 1) / 2**64
            places = (np.arange(self.count) + begin) * (ends[-1] / self.count)
            self._drawn = key, np.minimum(ends.searchsorted(places, "right"), self.count - 1)
        return self._drawn[1][items]

    def _weight(self) -> Array:
        """Return the weight of each item."""
        if self._weights is None:
            kind, _, name = (self._view.weights or "").partition(":")
            every = np.arange(self.count)
            if kind == "episode":
                which = self.items.trajectories(every)
                self._weights = 1.0 / self.items.trajectory[which]
            else:
                values = self.gather(name, self.items.locate(every), (0,))[:, 0]
                self._weights = _weights_of(kind, name, values)
        return self._weights

    def gather(self, name: str, where: Located, offsets: Sequence[int]) -> Array:
        """Return a stored field of items at some offsets, shape (items, offsets, *field shape)."""
        first, count = offsets[0], len(offsets)
        if self.rows.fields[name].free_axis:
            rows = self.items.rows(where.items, offsets)
            found = self.rows.gather(name, rows.ravel())
            return found.reshape(rows.shape)
        if where.rows is not None and tuple(offsets) == tuple(range(first, first + count)):
            return self.rows.windows(name, where.rows + first, count)
        rows = self.items.rows(where.items, offsets)
        found = self.rows.gather(name, rows.ravel())
        return found.reshape(*rows.shape, *found.shape[1:])


class Groups:
    """The trajectories, or blocks of rows, that all rows of a source are divided into.

    Attributes:
        noun: "episode", "trajectory", or "block" if nothing is known of trajectories.
        found: The trajectories.
    """

    def __init__(self, noun: str, found: Trajectories, count: int) -> None:
        """Sort them by their first places.

        Args:
            noun: What they are.
            found: The trajectories.
            count: Number of rows.
        """
        self.noun, self.found = noun, found
        self._order = np.argsort(found.start, kind="stable")
        self._starts = found.start[self._order]
        self._places: Index | None = None
        if found.places is not None:
            self._places = np.empty(count, np.intp)
            self._places[found.places[:count]] = np.arange(count)

    def find(self, rows: Index) -> Index:
        """Return the place in `found` of the trajectory of each row, shape (rows,)."""
        places = rows if self._places is None else self._places[rows]
        return self._order[self._starts.searchsorted(places, "right") - 1]


def window_of(view: ViewOptions, name: str) -> Window:
    """Return the window of a name; of a stored field without one, its value at offset 0."""
    return view.windows.get(name) or Window(name, (0,), is_single=True)


def _growing_blocks(count: int) -> Trajectories:
    """Return blocks of rows, larger ones where there are many before, so that they stay few."""
    size, stop = _BLOCK, _BLOCK * _SAME_SIZE
    starts = [np.arange(0, min(stop, count), size)]
    while stop < count:
        starts.append(np.arange(stop, min(2 * stop, count), size))
        size, stop = 2 * size, 2 * stop
    return _blocks(np.concatenate(starts), count)


def _blocks(start: Index, count: int) -> Trajectories:
    """Return the blocks of `count` rows that begin at some of them."""
    number = np.arange(len(start))
    return Trajectories(np.full(len(start), -1), number, start, np.diff(start, append=count), None)


def _inside(name: str, values: Array, low: float, high: float) -> Flags:
    if values.ndim > 1:
        raise ConfigError(f'View.episodes: "{name}" has several values in each episode.')
    return (values >= low) & (values <= high)


def _weights_of(kind: str, name: str, values: Array) -> Array:
    """Return weights by the values of a field."""
    if values.ndim > 1:
        raise ConfigError(f'View.weights: the field "{name}" has several values in each row.')
    if kind == "class":
        _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
        return np.asarray(1.0 / counts[place])
    weights = values.astype(np.float64)
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
        raise ConfigError(f'View.weights: the field "{name}" has negative values, or none above 0.')
    return weights
