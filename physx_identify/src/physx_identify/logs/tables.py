"""Tables: the columns of a log's file, of any format that physx reads."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from physx_core.dataset import Dataset, holds_dataset
from physx_core.errors import listed, nearest
from physx_core.typing import Array, Vector
from physx_formats import all_formats
from physx_gym import read_log as read_episode
from physx_gym.errors import LogError
from physx_identify.errors import IdentificationError

_MOST = 2**30


def read_table(
    path: Path,
    joints: Sequence[str],
    episode: int | None,
    topic: str | None,
    chosen: Collection[str],
) -> tuple[dict[str, Vector], dict[str, str]]:
    """Return the columns of a file, each of shape (rows, numbers), and their units.

    Args:
        path: The file or folder.
        joints: Joints that the table should be of, where a file has several tables.
        episode: Which episode; None: the only one.
        topic: Which table of a file with several; None: the only one of these joints.
        chosen: Names of columns that are used; if one is that of a column with its topic, all are.

    Raises:
        IdentificationError: If there is no such file, episode or table, or there are several.
        ExchangeError: If the file cannot be read.
    """
    table, units = _table_of(path)
    if topic is not None or not any("/" in name and name in table for name in chosen):
        table, units = _topic(path, table, units, topic, joints)
    return _episode(path, table, episode), units


def _table_of(path: Path) -> tuple[dict[str, Vector], dict[str, str]]:
    if not path.exists():
        raise IdentificationError(f"There is no log {path}.")
    if (path / "meta" / "info.json").is_file():
        return _lerobot(path)
    if holds_dataset(path) or holds_dataset(path / "dataset"):
        with Dataset.open(path) as dataset:
            mode = "training" if "training" in dataset.modes else dataset.modes[0]
            fields = dataset.fields(mode)
            values = {name: _flat(dataset[mode][name][:]) for name in fields}
            return values, {name: field.unit for name, field in fields.items()}
    if path.suffix in (".h5", ".hdf5"):
        try:
            episode = read_episode(path)
        except LogError:  # a table of another program
            return _file(path)
        return {n: _flat(each) for n, each in episode.variables.items()}, dict(episode.units)
    return _file(path)


def _lerobot(path: Path) -> tuple[dict[str, Vector], dict[str, str]]:
    tables = [_file(part)[0] for part in sorted((path / "data").rglob("*.parquet"))]
    if not tables:
        raise IdentificationError(f"{path} has no files data/**/*.parquet.")
    return {name: np.concatenate([each[name] for each in tables]) for name in tables[0]}, {}


def _file(path: Path) -> tuple[dict[str, Vector], dict[str, str]]:
    begin = b""
    if not path.is_dir():
        with path.open("rb") as file:
            begin = file.read(8)
    for each in all_formats().values():
        if each.open is None or not each.recognizes(path, begin):
            continue
        with each.open(path, _MOST) as (columns, notes):
            numbers = {
                name: column
                for name, column in columns.items()
                if not column.problem and column.dtype.kind in "biuf" and column.shape
            }
            units = {name: column.unit for name, column in numbers.items()}
            for mode in notes.modes.values():
                units |= {name: field.unit for name, field in mode.items() if field.unit}
            return {n: _flat(c.read(0, c.shape[0])) for n, c in numbers.items()}, units
    raise IdentificationError(f"{path} is of no known format: {listed(all_formats())}.")


def _flat(values: Array) -> Vector:
    found = np.asarray(values)
    return found.reshape(len(found), -1).astype(np.float64)


def _topic(
    path: Path,
    table: dict[str, Vector],
    units: dict[str, str],
    wanted: str | None,
    joints: Sequence[str],
) -> tuple[dict[str, Vector], dict[str, str]]:
    """Return the columns of one topic, by their own names."""
    groups: dict[str, dict[str, str]] = {}
    for name in table:
        group, _, own = name.rpartition("/")
        groups.setdefault(group, {})[own] = name
    if wanted is None and "" in groups:
        return table, units
    chosen = groups
    if wanted is not None:
        own = wanted.strip("/")
        chosen = {g: names for g, names in groups.items() if own in (g, g.rpartition("/")[0])}
        if not chosen:
            raise IdentificationError(
                f'{path} has no topic "{wanted}".{nearest(own, groups)} It has: {listed(groups)}.'
            )
    if len(chosen) > 1:
        of = {g: {n.partition(".")[2] for n in names} - {""} for g, names in chosen.items()}
        full = [group for group in chosen if all(joint in of[group] for joint in joints)]
        if len(full) != 1:
            texts = [f"{group} ({', '.join(sorted(of[group]))})" for group in full or chosen]
            what = "several topics of all joints" if full else "no topic of all joints"
            raise IdentificationError(
                f"{path} has {what}: {listed(texts)}. Choose one: topic (--topic)."
            )
        chosen = {full[0]: chosen[full[0]]}
    [names] = chosen.values()
    return {own: table[name] for own, name in names.items()}, {
        own: units[name] for own, name in names.items() if name in units
    }


def _episode(path: Path, table: dict[str, Vector], wanted: int | None) -> dict[str, Vector]:
    name = next((name for name in ("episode", "episode_index") if name in table), None)
    if name is None:
        if wanted is not None:
            raise IdentificationError(f"{path} has no column of episodes.")
        return table
    numbers = table[name][:, 0]
    known = np.unique(numbers)
    if wanted is None and len(known) > 1:
        raise IdentificationError(
            f"{path} has {len(known)} episodes. Choose one: episode (--episode)."
        )
    rows = numbers == (known[0] if wanted is None else wanted)
    if not rows.any():
        raise IdentificationError(f"{path} has no episode {wanted}; its first is {known[0]:g}.")
    return {key: values[rows] for key, values in table.items() if key != name}
