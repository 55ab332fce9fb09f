"""Exports the trajectories of a mode to Minari, as episodes for offline reinforcement learning.

A Minari episode of n steps has n + 1 observations: row i of a trajectory is observation i, and its
action and reward belong to the step to row i + 1. A trajectory of n + 1 rows thus becomes n steps;
the action and reward of its last row, which lead to no further row, are kept in ``infos/last``.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import Episode
from physx_core.fields import Field
from physx_core.typing import Batch
from physx_formats.errors import ExchangeError
from physx_formats.files.roles import Roles
from physx_formats.format import Format
from physx_formats.table import ExportOptions, Table, encode_notes, import_library

_OVERHEAD = 6000
"""Upper bound on the bytes that an array of an episode takes in addition to its values."""
_OWN_ARRAYS = 4
"""Arrays that Minari adds to each episode: actions, rewards, terminations, truncations."""
_NAME = re.compile(r"[-_\w]+-v\d+")


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the trajectories of one mode as a Minari dataset in HDF5.

    ``minari.MinariDataset(out / "data")`` opens it; so does ``minari.load_dataset(name)`` if the
    folder has a name such as ``arm-v0`` and is in the folder ``MINARI_DATASETS_PATH``.

    Returns:
        Number of rows that are in no episode because they are trajectories of one row.
    """
    (table,) = tables
    roles = Roles.choose(table, options)
    minari, storages, serialization, collector, _ = (
        import_library(name, "Exporting to Minari", "minari")
        for name in (
            "minari",
            "minari.dataset.minari_storage",
            "minari.serialization",
            "minari.data_collector",
            "PIL",  # its HDF5 storage needs it
        )
    )
    episodes = [e for e in table.trajectories if len(e.rows) > 1]
    if not episodes:
        raise ExchangeError(
            f'No trajectory of mode "{table.mode}" has two samples, as a Minari episode needs. A '
            "trajectory ends where an environment calls new_episode() and where check_sample() "
            "rejects a sample."
        )
    _check_space(table, out, len(episodes))
    out.mkdir()
    observed = _space(table.fields, roles.observations, entries=roles.entries)
    acted = _space(table.fields, roles.actions, entries=False)
    storage = storages.MinariStorage.new(
        out / "data",
        observation_space=serialization.deserialize_space(observed),
        action_space=serialization.deserialize_space(acted),
        jpeg_encoding=False,
    )
    storage.update_episodes(
        collector.EpisodeBuffer(**_episode(table, roles, episode)) for episode in episodes
    )
    name = out.name if _NAME.fullmatch(out.name) else "physx-v0"
    storage.update_metadata(
        {
            "dataset_id": name,
            "minari_version": minari.__version__,
            "physx": json.loads(encode_notes(tables)),
        }
    )
    return table.rows - sum(len(episode.rows) for episode in episodes)


def _check_space(table: Table, out: Path, episodes: int) -> None:
    """Check that the disk has room: HDF5, which Minari writes with, crashes on a full disk."""
    arrays = episodes * (len(table.fields) + _OWN_ARRAYS)
    needed, free = (
        table.rows * table.row_nbytes + arrays * _OVERHEAD,
        shutil.disk_usage(out.parent).free,
    )
    if needed > free:
        raise ExchangeError(
            f"{len(table.fields)} fields in {episodes} episodes take up to {needed / 1e6:.1f} MB, "
            f"but the disk has {free / 1e6:.1f} MB left."
        )


def _episode(table: Table, roles: Roles, episode: Episode) -> dict[str, Any]:
    rows: Batch = {name: table.view[name][episode.rows] for name in table.fields}
    table.advance(sum(array.nbytes for array in rows.values()))
    steps = len(episode.rows) - 1
    last = {name: rows[name][steps:] for name in (*roles.actions, *_given(roles.rewards))}
    used = {*roles.observations, *last}
    infos: dict[str, Any] = {name: array for name, array in rows.items() if name not in used}
    if last:
        infos["last"] = last
    truncations = np.zeros(steps, np.bool_)
    truncations[-1] = True
    observed = {name: rows[name] for name in roles.observations}
    acted = {name: rows[name][:steps] for name in roles.actions}
    return {
        "observations": observed if roles.entries else _single(observed),
        "actions": _single(acted) if acted else np.zeros(steps, np.int64),
        "rewards": rows[roles.rewards][:steps] if roles.rewards else np.zeros(steps),
        "terminations": np.zeros(steps, np.bool_),
        "truncations": truncations,
        "infos": infos or None,
    }


def _given(name: str | None) -> list[str]:
    return [] if name is None else [name]


def _single(arrays: Batch) -> Any:
    return next(iter(arrays.values())) if len(arrays) == 1 else arrays


def _space(fields: Mapping[str, Field], names: Sequence[str], *, entries: bool) -> dict[str, Any]:
    """Return the space of fields in the form that Minari stores."""
    if not names:
        return {"type": "Discrete", "n": 1, "start": 0}
    boxes = {name: _box(fields[name]) for name in names}
    single = len(names) == 1 and not entries
    return boxes[names[0]] if single else {"type": "Dict", "subspaces": boxes}


def _box(field: Field) -> dict[str, Any]:
    dtype, shape = np.dtype(field.dtype), field.shape or ()
    if dtype.kind == "c" or 0 in shape:
        raise ExchangeError(
            f'Minari has no space for the field "{field.name}" of type {dtype} and shape '
            f"{field.shape}."
        )
    low: Any = -np.inf
    high: Any = np.inf
    if dtype.kind == "b":
        low, high = 0, 1
    elif dtype.kind in "iu":
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    bounds = {"low": np.full(shape, low, dtype), "high": np.full(shape, high, dtype)}
    return {"type": "Box", "dtype": dtype.name, "shape": shape, **bounds}


FORMAT = Format(
    write=write, loses=("way back", "records"), options=("observations", "actions", "rewards")
)
