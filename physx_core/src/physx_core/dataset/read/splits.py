"""Splits: parts of a mode as lists of its rows; nothing is copied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from physx_core.dataset.read import strategy as strategies
from physx_core.dataset.read.cache import ColumnCache
from physx_core.dataset.read.episodes import find_episodes
from physx_core.dataset.read.sampling import Batches
from physx_core.dataset.read.views import FieldView, ModeView
from physx_core.errors import ConfigError
from physx_core.fields import RESERVED, Field
from physx_core.statistics import Normalization, RunningStatistics
from physx_core.typing import Array, Batch

Index = NDArray[np.intp]
_EXACT = 1e-9
_BLOCK = 2**20


@dataclass(frozen=True)
class Source:
    """The rows that are split.

    Attributes:
        view: Gives the rows.
        columns: Gives batches of them.
        mode: Name of the mode.
        rows: How many rows there are.
    """

    view: ModeView
    columns: ColumnCache
    mode: str
    rows: int


class SubsetField:
    """One field's rows of a subset; takes what a `FieldView` takes and returns copies.

    Attributes:
        field: The field.
    """

    def __init__(self, view: FieldView, rows: Index) -> None:
        self.field = view.field
        self._view, self._rows = view, rows

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, *field shape)."""
        return (len(self._rows), *(self.field.shape or ()))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        return self._view.dtype

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, rows: Any) -> Any:
        chosen = self._rows[rows]
        return self._view[int(chosen) if chosen.ndim == 0 else chosen]


class Subset:
    """Some rows of a mode, in the order of writing.

    The rows are those that were there when it was made; later ones are in no part.

    Attributes:
        mode: Name of the mode.
        rows: Numbers of the rows in the mode, rising.
    """

    def __init__(self, source: Source, rows: Index) -> None:
        self.mode, self.rows = source.mode, rows
        self._source = source

    @property
    def num_samples(self) -> int:
        """How many rows there are."""
        return len(self.rows)

    @property
    def fields(self) -> dict[str, Field]:
        """The fields by name."""
        return {name: view.field for name, view in self._source.view.items()}

    def __getitem__(self, name: str) -> SubsetField:
        return SubsetField(self._source.view[name], self.rows)

    def batches(
        self,
        batch_size: int,
        *,
        shuffle: bool = False,
        seed: int | Sequence[int] | None = None,
        epochs: int | None = 1,
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
        reuse: bool = False,
        normalize: bool | Mapping[str, Normalization] = False,
        strategy: strategies.Choice = "auto",
    ) -> Iterator[Batch]:
        """Go through the rows in batches; arguments and errors are those of `Dataset.batches`.

        ``normalize=True`` takes `normalization`, that of these rows alone.
        """
        if isinstance(normalize, bool):
            normalize = self.normalization() if normalize else {}
        names = list(self.fields if fields is None else fields)
        random = np.random.default_rng(seed) if shuffle else None
        kind = None if dtype is None else np.dtype(dtype)
        return iter(
            Batches(
                self._source.columns,
                self.mode,
                names,
                batch_size,
                epochs,
                random,
                kind,
                reuse,
                strategies.check(strategy),
                normalize,
                self.rows,
            )
        )

    def normalization(self) -> dict[str, Normalization]:
        """Compute what normalizes the floating fields from these rows alone, in one pass.

        Raises:
            DatasetError: A partition is missing or damaged.
        """
        found = {}
        for name, field in self.fields.items():
            if name not in RESERVED and np.dtype(field.dtype).kind == "f":
                found[name] = self._statistics(name, field).normalization()
        return found

    def _statistics(self, name: str, field: Field) -> RunningStatistics:
        statistics, view = RunningStatistics(), self._source.view[name]
        step = max(1, _BLOCK // max(1, field.nbytes))
        for start in range(0, self._source.rows, step):
            stop = min(start + step, self._source.rows)
            first, last = np.searchsorted(self.rows, (start, stop))
            if first < last:
                statistics.update(view[start:stop][self.rows[first:last] - start])
        return statistics

    def __repr__(self) -> str:
        return f"<{self.num_samples} samples of {self.mode}>"


def split(source: Source, shares: Mapping[str, float], by: str, seed: int) -> dict[str, Subset]:
    """Return the parts of a mode: see `Dataset.split`."""
    _check(shares, by)
    random = np.random.default_rng(seed)
    if by == "row":
        rows = random.permutation(source.rows)
        ends = [round(end * source.rows) for end in _ends(shares)]
    else:
        rows, ends = _by_episode(source, shares, random)
    parts = {}
    for name, start, stop in zip(shares, [0, *ends], ends, strict=False):
        if start >= stop:
            raise ConfigError(
                f'The part "{name}" would be empty: there are {source.rows} samples of mode '
                f'"{source.mode}".'
            )
        parts[name] = Subset(source, np.sort(rows[start:stop]))
    return parts


def _check(shares: Mapping[str, float], by: str) -> None:
    if by not in ("row", "episode"):
        raise ConfigError(f'by is {by!r} but must be "row" or "episode".')
    values = np.array(list(shares.values()), np.float64)
    if not values.size or not (values > 0).all() or values.sum() > 1 + _EXACT:
        raise ConfigError(
            f"The shares are {dict(shares)} but must be above 0, and 1 at most together."
        )


def _ends(shares: Mapping[str, float]) -> list[float]:
    """Return where each part ends, as a share of all rows; 1 is 1 in spite of rounding."""
    ends = np.cumsum(list(shares.values()))
    return [1.0 if abs(end - 1) < _EXACT else float(end) for end in ends]


def _by_episode(
    source: Source, shares: Mapping[str, float], random: np.random.Generator
) -> tuple[Array, list[int]]:
    """Return all rows, shuffled by trajectory, and where each part ends among them.

    Each part has one trajectory at least, and ends with the one that brings it nearest to its
    share of the rows.
    """
    episodes = find_episodes(source.view, source.rows)
    if len(episodes) < len(shares):
        raise ConfigError(
            f'Mode "{source.mode}" has {len(episodes)} trajectories, which cannot be split into '
            f'{len(shares)} parts by episode. Split by="row".'
        )
    order = random.permutation(len(episodes))
    ends = np.cumsum([len(episodes[number].rows) for number in order])
    counts: list[int] = []
    for number, share in enumerate(_ends(shares)):
        nearest = int(np.abs(ends - share * source.rows).argmin()) + 1
        most = len(episodes) - (len(shares) - number - 1)
        counts.append(min(max(nearest, (counts or [0])[-1] + 1), most))
    rows = np.concatenate([episodes[number].rows for number in order])
    return rows, [int(ends[count - 1]) for count in counts]
