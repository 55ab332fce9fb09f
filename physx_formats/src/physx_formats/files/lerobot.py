"""LeRobot's dataset format, version 3: Parquet files with the episodes of a mode in sequence.

A row is a frame: ``observation.*``, ``action``, ``next.reward``, and ``info.*`` for other fields.
LeRobot's own policies need ``observation.state``, one vector, which several fields may be.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import Episode
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array, Batch
from physx_formats.errors import ExchangeError
from physx_formats.files.roles import OBSERVATION, Roles
from physx_formats.format import Format
from physx_formats.table import ExportOptions, Table, encode_notes, import_library

VERSION = "v3.0"
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FILES_PER_CHUNK = 1000
_FILE_MEGABYTES = 100
_MOST_AXES = 5
_DESCRIBED = 2**14
"""Number of components whose statistics are kept in memory before they are written."""
_NAMED = ("action", "next.reward", "next.done", "next.success")
_COUNTERS = {"frame_index": "i8", "episode_index": "i8", "index": "i8", "task_index": "i8"}


@dataclass(frozen=True)
class _Feature:
    """A column of the frames: one field, or several concatenated."""

    name: str
    fields: tuple[Field, ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.fields[0].dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame; a single number is a vector of length 1."""
        if len(self.fields) == 1:
            return self.fields[0].shape or (1,)
        return (sum((of.shape or (1,))[0] for of in self.fields),)

    def of(self, rows: Batch) -> Array:
        """Return the frames of rows, shape (rows, *shape)."""
        count = len(rows[self.fields[0].name])
        parts = [rows[of.name].reshape(count, *(of.shape or (1,))) for of in self.fields]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the trajectories of one mode; ``LeRobotDataset(name, root=out)`` opens them."""
    (table,) = tables
    if options.fps is None:
        raise ConfigError(
            "LeRobot needs the number of frames per second: give it with fps (--fps on the command "
            "line), such as fps=50 for steps of 0.02 s."
        )
    import_library("pyarrow.parquet", "Exporting to LeRobot", "lerobot")
    pandas = import_library("pandas", "Exporting to LeRobot", "lerobot")
    task = options.task or "simulate"
    features = _features(table, Roles.choose(table, options), options.features)
    episodes = table.trajectories
    with _Writer(out, features, options.fps, task) as writer:
        for number, episode in enumerate(episodes):
            writer.write(table, number, episode)
    pandas.DataFrame({"task_index": [0]}, index=[task]).to_parquet(out / "meta/tasks.parquet")
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": table.rows,
        "total_tasks": 1,
        "chunks_size": _FILES_PER_CHUNK,
        "data_files_size_in_mb": _FILE_MEGABYTES,
        "video_files_size_in_mb": _FILE_MEGABYTES,
        "fps": options.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": _describe(features),
        "physx": json.loads(encode_notes(tables)),
    }
    (out / "meta/info.json").write_text(json.dumps(info, indent=4))
    (out / "meta/stats.json").write_text(json.dumps(writer.statistics(), indent=4))
    return 0


def _features(table: Table, roles: Roles, named: Mapping[str, Sequence[str]]) -> list[_Feature]:
    """Return the columns of the frames by the roles of the fields, and those that are named."""
    fields = table.fields
    features = [_Feature(f"{OBSERVATION}{name}", (fields[name],)) for name in roles.observations]
    if len(features) == 1 and not named:
        features = [_Feature("observation.state", features[0].fields)]
    if roles.actions:
        features.append(_Feature("action", tuple(fields[name] for name in roles.actions)))
    if roles.rewards:
        features.append(_Feature("next.reward", (fields[roles.rewards],)))
    for name, of in named.items():
        if not (name.startswith(OBSERVATION) or name in _NAMED):
            raise ConfigError(
                f'LeRobot has no feature "{name}". It has: {listed(_NAMED)}, {OBSERVATION}NAME.'
            )
        if not of or any(each.name == name for each in features):
            raise ConfigError(f'The feature "{name}" has {"two lots of" if of else "no"} fields.')
        features.append(_Feature(name, tuple(fields[each] for each in of)))
    used = {of.name for feature in features for of in feature.fields}
    features += [_Feature(f"info.{n}", (of,)) for n, of in fields.items() if n not in used]
    for feature in features:
        _check(feature)
    return features


def _check(feature: _Feature) -> None:
    names = " and ".join(f'"{of.name}"' for of in feature.fields)
    if feature.dtype.kind == "c" or 0 in feature.shape or len(feature.shape) > _MOST_AXES:
        raise ExchangeError(
            f"LeRobot has no feature for the field {names} of type {feature.dtype} and shape "
            f"{feature.shape}: it takes real numbers with 1 to {_MOST_AXES} axes."
        )
    if len(feature.fields) > 1 and any(
        len(of.shape or (1,)) > 1 or of.dtype != feature.dtype for of in feature.fields
    ):
        raise ExchangeError(
            f'A LeRobot feature is one vector: the fields {names} of "{feature.name}" must be '
            "vectors of the same type."
        )


def _describe(features: Sequence[_Feature]) -> dict[str, Any]:
    """Return the table of features in ``info.json``."""
    own = {
        feature.name: {
            "dtype": feature.dtype.name,
            "shape": list(feature.shape),
            "names": _component_names(feature),
            "unit": ", ".join(dict.fromkeys(of.unit for of in feature.fields if of.unit)),
        }
        for feature in features
    }
    single = {"shape": [1], "names": None}
    added = {name: {"dtype": np.dtype(kind).name, **single} for name, kind in _COUNTERS.items()}
    return {**own, "timestamp": {"dtype": "float32", **single}, **added}


def _component_names(feature: _Feature) -> list[str] | None:
    if len(feature.shape) > 1:
        return None
    named = [(of.name, (of.shape or (1,))[0]) for of in feature.fields]
    return [
        name if length == 1 else f"{name}_{place}"
        for name, length in named
        for place in range(length)
    ]


class _Writer(AbstractContextManager["_Writer"]):
    """Writes episodes to files of limited size, and their descriptions to a separate file."""

    def __init__(self, out: Path, features: Sequence[_Feature], fps: int, task: str) -> None:
        self._arrow = import_library("pyarrow", "Exporting to LeRobot", "lerobot")
        self._parquet = import_library("pyarrow.parquet", "Exporting to LeRobot", "lerobot")
        self._out, self._features, self._fps, self._task = out, features, fps, task
        self._total = {feature.name: RunningStatistics() for feature in features}
        self._components = sum(math.prod(feature.shape) for feature in features)
        self._described: list[dict[str, Any]] = []
        self._file: Any = None
        self._table: Any = None
        self._frames = self._files = self._nbytes = 0

    def write(self, table: Table, number: int, episode: Episode) -> None:
        """Write an episode."""
        rows: Batch = {name: table.view[name][episode.rows] for name in table.fields}
        table.advance(sum(array.nbytes for array in rows.values()))
        frames = {feature.name: feature.of(rows) for feature in self._features}
        count, first = len(episode.rows), self._frames
        self._frames += count
        self._write_frames(frames | self._added(number, first, count))
        chunk, file = divmod(self._files - 1, _FILES_PER_CHUNK)
        found: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self._task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": first,
            "dataset_to_index": self._frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, values in frames.items():
            own = RunningStatistics()
            own.update(values)
            self._total[name].merge(own)
            found |= {f"stats/{name}/{key}": value for key, value in _summary(own).items()}
        self._described.append(found)
        if len(self._described) * self._components >= _DESCRIBED:
            self._write_described()

    def _added(self, number: int, first: int, count: int) -> Batch:
        """Return the columns that LeRobot adds to each frame."""
        places = np.arange(count)
        columns = {
            "timestamp": (places / self._fps).astype("f4"),
            "frame_index": places,
            "episode_index": np.full(count, number),
            "index": first + places,
            "task_index": np.zeros(count, "i8"),
        }
        return {name: column[:, np.newaxis] for name, column in columns.items()}

    def _write_frames(self, columns: Batch) -> None:
        table = self._arrow.table({name: self._column(a) for name, a in columns.items()})
        if self._file is None or self._nbytes + table.nbytes > _FILE_MEGABYTES * 1e6:
            if self._file is not None:
                self._file.close()
            self._file = self._new_file("data", self._files, table.schema)
            self._files, self._nbytes = self._files + 1, 0
        self._file.write_table(table)
        self._nbytes += table.nbytes

    def _write_described(self) -> None:
        table = self._arrow.Table.from_pylist(self._described)
        self._described = []
        if self._table is None:
            self._table = self._new_file("meta/episodes", 0, table.schema)
        self._table.write_table(table)

    def _new_file(self, folder: str, number: int, schema: Any) -> Any:
        chunk, file = divmod(number, _FILES_PER_CHUNK)
        path = self._out / folder / _FILE.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        return self._parquet.ParquetWriter(path, schema, compression="snappy")

    def _column(self, values: Array) -> Any:
        """Return frames as an Arrow array: numbers, vectors of fixed length, or nested lists."""
        array = self._arrow.array(values.reshape(-1))
        shape = values.shape[1:]
        if shape == (1,):
            return array
        if len(shape) == 1:
            return self._arrow.FixedSizeListArray.from_arrays(array, shape[0])
        for length in map(int, reversed(shape)):
            starts = np.arange(0, len(array) + 1, length).astype("i4")
            array = self._arrow.ListArray.from_arrays(starts, array)
        return array

    def statistics(self) -> dict[str, Any]:
        """Return the statistics of all frames."""
        return {name: _summary(found) for name, found in self._total.items()}

    def __exit__(self, *error: object) -> None:
        """Write the remaining descriptions and close the files."""
        if self._described and error[0] is None:
            self._write_described()
        for file in (self._file, self._table):
            if file is not None:
                file.close()


def _summary(found: RunningStatistics) -> Mapping[str, Any]:
    values = {"min": found.minimum, "max": found.maximum, "mean": found.mean, "std": found.std}
    return {name: value.tolist() for name, value in values.items()} | {"count": [found.count]}


FORMAT = Format(
    write=write,
    loses=("way back", "records"),
    options=("observations", "actions", "rewards", "fps", "task", "features"),
)
