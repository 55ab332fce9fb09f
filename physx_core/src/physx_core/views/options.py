"""ViewOptions: which rows of stored data to learn from, in which form, order and parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, NamedTuple

from physx_core.config import at_least, configuration
from physx_core.errors import ConfigError


class Window(NamedTuple):
    """Values of a field at several rows of a trajectory, relative to a row of reference.

    Attributes:
        field: Name of the stored field.
        at: The offsets in rows, ascending or not, shape (n,).
        is_single: Whether the values have no axis for the offsets, as there is one.
    """

    field: str
    at: tuple[int, ...]
    is_single: bool = False


@configuration
class ViewOptions:
    """The options of a `View`, which reads nothing until it is opened."""

    sources: dict[str, float] = field(default_factory=dict)
    """Folders of sessions or datasets, each with its share of every batch; empty: the dataset of
    the run alone."""
    window: dict[str, Any] = field(default_factory=dict)
    """Windows by name: the stored field and the offsets in rows, in Python
    ``{"past": ("state", [-2, -1, 0])}``, in TOML ``window.past = {field = "state", at = [-2, 0]}``.
    A window never reaches into another trajectory. With a single number instead of a list, the
    values get no axis for it. Fields without a window are taken at offset 0. The entries of free
    axes are end to end, also those of the rows of a window: see `physx_core.packing.pack`."""
    stride: int = at_least(1, 1)
    """Number of rows between the reference rows of consecutive windows of a trajectory."""
    edges: str = field(default="inside", metadata={"choices": ("inside", "pad")})
    """Windows at the ends of a trajectory: "inside" leaves out those that would reach beyond it;
    "pad" repeats its first or last row there, and adds ``NAME_is_pad``, true for these."""
    episodes: dict[str, Any] = field(default_factory=dict)
    """Which independent episodes: a parameter or ``episode``, their number, with the smallest and
    the largest value, or ``status`` with "finished" or "cut". Empty: all."""
    where: str | None = None
    """A function "package.module:function" or "script.py:function" that chooses episodes: it gets
    their parameters and fields by name, arrays of shape (episodes, ...), and returns which count,
    booleans of shape (episodes,). None: all."""
    folds: int = at_least(2, 5)
    """Number of parts into which the episodes are divided evenly, by their numbers: more episodes
    never move one from one part to another."""
    hold_back: bool = True
    """Whether a part is held back for validation."""
    fold: int = at_least(0, 0)
    """The part that is. Of fewer episodes than `folds`, a piece of each is: with 0 its end."""
    test_fold: int | None = at_least(0, None)
    """The part that is held back for a test; None: none is."""
    fold_seed: int = at_least(0, 0)
    """Seed of the division."""
    weights: str | None = None
    """How often an item occurs in an epoch: "episode", equally often for each episode;
    "class:FIELD", equally often for each value of a field; "field:FIELD", in proportion to it.
    None: each occurs once."""
    order: str | None = field(default=None, metadata={"choices": ("exact", "blocks", "stored")})
    """Order of the items in an epoch; None: "exact" or, for more than two million of less than 4 kB
    each, "blocks"."""
    drop_last: bool = False
    """Leave out the last batch of an epoch if it has fewer items than the others."""
    epoch: str = field(default="first", metadata={"choices": ("first", "all")})
    """When an epoch of several sources ends: as soon as each item of the "first" of them was used,
    or of "all"; those with fewer start anew, in another order."""

    def __post_init__(self) -> None:
        """Check what options mean together, and store windows as tables.

        Raises:
            ConfigError: If they contradict one another.
        """
        windows = {name: _parse_window(name, given) for name, given in self.window.items()}
        tables = {n: {"field": w.field, "at": w.at[0] if w.is_single else list(w.at)}
                  for n, w in windows.items()}  # fmt: skip
        object.__setattr__(self, "window", tables)
        for name, share in self.sources.items():
            if not share > 0:
                raise ConfigError(f"View.sources: the share of {name} is {share}, not positive.")
        for part, fold in self.held.items():
            name = {"validation": "fold", "test": "test_fold"}[part]
            if fold is not None and fold >= self.folds:
                raise ConfigError(
                    f"View.{name} is {fold}, but of {self.folds} folds the last is "
                    f"{self.folds - 1}."
                )
        if self.hold_back and self.fold == self.test_fold:
            raise ConfigError(
                f"View.fold and View.test_fold are the same: {self.fold}. Choose another one, or "
                "hold nothing back for validation (hold_back=False)."
            )
        kind, _, name = (self.weights or "episode").partition(":")
        if not ((kind == "episode" and not name) or (kind in ("class", "field") and name)):
            raise ConfigError(
                f'View.weights is {self.weights!r} but must be "episode", "class:FIELD" or '
                '"field:FIELD".'
            )
        _check_ranges(self.episodes)

    @property
    def held(self) -> dict[str, int | None]:
        """The number of the part that is held back for "validation" and "test"."""
        return {"validation": self.fold if self.hold_back else None, "test": self.test_fold}

    @property
    def windows(self) -> dict[str, Window]:
        """The windows by name."""
        return {name: _parse_window(name, given) for name, given in self.window.items()}


def _parse_window(name: str, given: Any) -> Window:
    if isinstance(given, Mapping) and given.keys() == {"field", "at"}:
        stored, at = given["field"], given["at"]
    elif isinstance(given, (tuple, list)) and len(given) == 2:
        stored, at = given
    else:
        stored, at = None, None
    is_single = type(at) is int
    offsets = [at] if is_single else at
    right = isinstance(offsets, (list, tuple)) and bool(offsets)
    if not (isinstance(stored, str) and right and all(type(o) is int for o in offsets)):
        raise ConfigError(
            f"View.window: {name} is {given!r} but must be a field and its offsets in rows, for "
            'example ("state", [-1, 0]), or in TOML {field = "state", at = [-1, 0]}.'
        )
    return Window(stored, tuple(offsets), is_single)


def _check_ranges(episodes: Mapping[str, Any]) -> None:
    for name, given in episodes.items():
        if name == "status":
            if given not in ("finished", "cut"):
                raise ConfigError(
                    f'View.episodes: status is {given!r} but must be "finished" or "cut".'
                )
        elif not (
            isinstance(given, (list, tuple))
            and len(given) == 2
            and all(isinstance(each, (int, float)) for each in given)
        ):
            raise ConfigError(
                f"View.episodes: {name} is {given!r} but must be its smallest and largest value."
            )
