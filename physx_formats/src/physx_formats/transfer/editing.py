"""Copies a dataset with other rows, other fields, or fields of other names and types."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from numpy.typing import DTypeLike

from physx_core.dataset import EPISODES, TABLE_FIELDS, Dataset
from physx_core.errors import ConfigError
from physx_core.views import Part, View
from physx_formats.table import Advance, check_new
from physx_formats.transfer.edited_fields import EditedFields
from physx_formats.transfer.edited_rows import EditedMode, Function, name_of

_ALL = View(hold_back=False)


def edit(
    directory: str | Path,
    out: str | Path,
    *,
    modes: Sequence[str] = (),
    view: View = _ALL,
    part: Part = "all",
    drop_episodes: Collection[int] = (),
    rows: Function | None = None,
    derive: Function | None = None,
    keep: Collection[str] = (),
    drop: Collection[str] = (),
    cast: Mapping[str, DTypeLike] | None = None,
    units: Mapping[str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    advance: Advance = lambda nbytes: None,
) -> dict[str, int]:
    """Write a dataset that has the rows and fields of another one as they should be.

    What is not named stays as it is, bit by bit: values, units, numbers, parameters and records of
    episodes, so that folds stay the same, too. The new dataset's `info` says what it was made from.

    The functions get the rows of one trajectory in temporal order, as a mapping from field names to
    arrays of shape (rows, *field shape), which are read when they are used; of episodes of one row,
    and of data that record no trajectories, as many at once as fit into a few megabytes. Names are
    those before `rename`.

    Args:
        directory: The folder of the dataset, or of the session that holds it.
        out: The new folder.
        modes: Names of the modes; empty: all that have rows.
        view: Chooses episodes, and every `View.stride`-th row of each trajectory. It has neither
            windows nor weights nor sources.
        part: Which part of the view: ``training``, ``validation``, ``test``, or ``all``.
        drop_episodes: Numbers of independent episodes to leave out.
        rows: Returns which rows to keep, booleans of shape (rows,). A reference
            ``"module:function"`` or ``"script.py:function"``, or the function itself.
        derive: Returns further fields, or new values of fields, by name: arrays of shape
            (rows, *field shape), or for a free axis a list of arrays, one for each row. Likewise.
        keep: The fields to keep; empty: all.
        drop: The fields to leave out.
        cast: New types of fields. Values are rounded as when they are stored: see `Field.convert`.
        units: New units of fields.
        rename: New names of fields.
        advance: Called with the number of bytes stored.

    Returns:
        Number of rows of each mode.

    Raises:
        ConfigError: If there is no such field, or the changes contradict one another.
        ExchangeError: If `out` exists, or a function returns something else.
        DatasetError: If the dataset is missing or damaged, nothing is left of a mode, or the disk
            is full. Nothing is left behind then.
        SampleError: If values do not fit the types.
    """
    out = Path(out)
    check_new(out)
    fields = EditedFields(keep, drop, cast or {}, units or {}, rename or {})
    changes = _Changes(modes, view, part, drop_episodes, rows, derive, fields)
    with (
        Dataset.open(directory) as source,
        tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".edit-") as folder,
    ):
        draft, done = Path(folder) / "dataset", {}
        names = changes.modes_of(source)
        with Dataset.create(draft, session="edit") as target:
            _record_origin(target, source, Path(directory), names, changes)
            _define_episodes(target, source)
            for name in names:
                done[name] = changes.make(target, EditedMode(source, name, Path(folder)), advance)
        fields.check_used()
        draft.rename(out)
    return done


@dataclass(frozen=True)
class _Changes:
    """What is changed: see `edit`."""

    modes: Sequence[str]
    view: View
    part: Part
    drop_episodes: Collection[int]
    rows: Function | None
    derive: Function | None
    fields: EditedFields

    def __post_init__(self) -> None:
        if self.view.windows or self.view.weights or self.view.sources:
            raise ConfigError("Only what a View says of episodes, stride and folds chooses rows.")

    def modes_of(self, source: Dataset) -> list[str]:
        """Return the modes that are copied row by row."""
        names = self.modes or (name for name in source.modes if source.num_samples(name))
        return [name for name in names if name != EPISODES or not source.has_episodes]

    def make(self, target: Dataset, mode: EditedMode, advance: Advance) -> int:
        """Store a mode as it should be, and return the number of its rows."""
        if self.derive is not None:
            mode.derive(self.derive)
        numbers = mode.choose(self.view, self.part, self.rows, self.drop_episodes)
        chooses = self.part != "all" or bool(self.view.episodes or self.view.where)
        lost = None if chooses else self.drop_episodes
        return mode.copy(target, self.fields.of(mode.fields), numbers, advance, lost)

    def said(self) -> dict[str, Any]:
        """Return them as plain data."""
        found: dict[str, Any] = {"modes": list(self.modes)} if self.modes else {}
        for name in ("episodes", "where", "stride"):
            if getattr(self.view, name) != getattr(_ALL, name):
                found[name] = getattr(self.view, name)
        if self.part != "all":
            folds = ("folds", "fold", "test_fold", "fold_seed")
            found |= {"part": self.part} | {name: getattr(self.view, name) for name in folds}
        if self.drop_episodes:
            found["drop_episodes"] = sorted(self.drop_episodes)
        functions = {"rows": self.rows, "derive": self.derive}
        found |= {name: name_of(given) for name, given in functions.items() if given is not None}
        return found | self.fields.said()


def _record_origin(
    target: Dataset, source: Dataset, directory: Path, modes: Sequence[str], changes: _Changes
) -> None:
    """Say what a dataset is made from, besides what that says of itself."""
    origin = {"dataset": directory.resolve().name, "digest": _digest(source, modes)}
    history = source.info.get("edits", [])
    target.update_info(**{**source.info, "edits": [*history, origin | changes.said()]})


def _define_episodes(target: Dataset, source: Dataset) -> None:
    """Define what is recorded of episodes as in another dataset, if it has any."""
    if not source.has_episodes:
        return
    own = {field.name for field in TABLE_FIELDS}
    known = [field for name, field in source.fields(EPISODES).items() if name not in own]
    target.define_episodes(
        [field for field in known if field.role != "episode"],
        [field for field in known if field.role == "episode"],
    )


def _digest(source: Dataset, modes: Sequence[str]) -> str:
    """Return a digest of what a dataset has in some modes, from its manifest alone."""
    known = [(mode, source.contents(mode)) for mode in modes]
    return blake2b(repr(known).encode(), digest_size=8).hexdigest()
