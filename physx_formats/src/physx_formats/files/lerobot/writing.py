"""Writes the trajectories of a mode in LeRobot's format."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import Episode, rows_per_block
from physx_core.errors import ConfigError
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array, Batch
from physx_formats.files.lerobot.features import COUNTERS, VERSION, Feature, find_features
from physx_formats.files.lerobot.layout import (
    DATA_PATH,
    FILE_BYTES,
    FILE_MEGABYTES,
    FILES_PER_CHUNK,
    VIDEO_PATH,
    data_file,
    episodes_file,
    place_of,
)
from physx_formats.files.lerobot.video import VideoWriter
from physx_formats.files.roles import Roles
from physx_formats.table import BLOCK, ExportOptions, Table, encode_notes, import_library

_DESCRIBED = 2**14
"""Number of components whose statistics are kept in memory before they are written."""


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
    features = find_features(table, Roles.choose(table, options), options.features)
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
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": FILE_MEGABYTES,
        "fps": options.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if writer.videos else None,
        "features": _describe(features, writer.videos),
        "physx": json.loads(encode_notes(tables)),
    }
    (out / "meta/info.json").write_text(json.dumps(info, indent=4))
    (out / "meta/stats.json").write_text(json.dumps(writer.statistics(), indent=4))
    return 0


def _describe(features: Sequence[Feature], videos: Mapping[str, VideoWriter]) -> dict[str, Any]:
    """Return the table of features in ``info.json``."""
    own = {feature.name: feature.describe() for feature in features}
    for name, video in videos.items():
        own[name]["info"] = video.info
    single = {"shape": [1], "names": None}
    added = {name: {"dtype": "int64", **single} for name in COUNTERS}
    return {**own, "timestamp": {"dtype": "float32", **single}, **added}


class _Writer(AbstractContextManager["_Writer"]):
    """Writes episodes to files of limited size, and their descriptions to a separate file.

    Attributes:
        videos: Those of features that are pictures, by name.
    """

    def __init__(self, out: Path, features: Sequence[Feature], fps: int, task: str) -> None:
        self._arrow = import_library("pyarrow", "Exporting to LeRobot", "lerobot")
        self._parquet = import_library("pyarrow.parquet", "Exporting to LeRobot", "lerobot")
        self._out, self._features, self._fps, self._task = out, features, fps, task
        self._total = {of.name: _statistics_of(of) for of in features}
        self.videos = {
            of.name: VideoWriter(out, of.name, of.shape, fps) for of in features if of.is_video
        }
        self._components = sum(3 if of.is_video else math.prod(of.shape) for of in features)
        self._described: list[dict[str, Any]] = []
        self._file: Any = None
        self._table: Any = None
        self._frames = self._files = self._nbytes = 0

    def write(self, table: Table, number: int, episode: Episode) -> None:
        """Write an episode."""
        count, first = len(episode.rows), self._frames
        self._frames += count
        columns: Batch = {}
        found: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self._task],
            "length": count,
            "dataset_from_index": first,
            "dataset_to_index": self._frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for feature in self._features:
            own, name = _statistics_of(feature), feature.name
            if feature.is_video:
                found |= self.videos[name].write(_pictures(table, feature, episode, own))
            else:
                rows = {of.name: table.view[of.name][episode.rows] for of in feature.fields}
                columns[name] = feature.of(rows)
                table.advance(columns[name].nbytes)
                own.update(columns[name])
            self._total[name].merge(own)
            summary = _summary(feature, own)
            found |= {f"stats/{name}/{key}": value for key, value in summary.items()}
        self._write_frames(columns | self._added(number, first, count))
        found["data/chunk_index"], found["data/file_index"] = place_of(self._files - 1)
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
        if self._file is None or self._nbytes + table.nbytes > FILE_BYTES:
            if self._file is not None:
                self._file.close()
            path = data_file(self._out, *place_of(self._files))
            self._file = self._new_file(path, table.schema)
            self._files, self._nbytes = self._files + 1, 0
        self._file.write_table(table)
        self._nbytes += table.nbytes

    def _write_described(self) -> None:
        table = self._arrow.Table.from_pylist(self._described)
        self._described = []
        if self._table is None:
            self._table = self._new_file(episodes_file(self._out), table.schema)
        self._table.write_table(table)

    def _new_file(self, path: Path, schema: Any) -> Any:
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
        return {of.name: dict(_summary(of, self._total[of.name])) for of in self._features}

    def __exit__(self, *error: object) -> None:
        """Write the remaining descriptions and close the files."""
        if self._described and error[0] is None:
            self._write_described()
        for file in (self._file, self._table, *self.videos.values()):
            if file is not None:
                file.close()


def _pictures(
    table: Table, feature: Feature, episode: Episode, statistics: RunningStatistics
) -> Iterator[Array]:
    """Yield the pictures of an episode in blocks, and add them to statistics."""
    (field,) = feature.fields
    step = rows_per_block(field.nbytes, BLOCK)
    for start in range(0, len(episode.rows), step):
        block = table.view[field.name][episode.rows[start : start + step]]
        table.advance(block.nbytes)
        statistics.update(block)
        yield block


def _statistics_of(feature: Feature) -> RunningStatistics:
    """Return empty statistics of a feature: of each component, or of each color."""
    return RunningStatistics((0, 1) if feature.is_video else ())


def _summary(feature: Feature, found: RunningStatistics) -> Mapping[str, Any]:
    values = {"min": found.minimum, "max": found.maximum, "mean": found.mean, "std": found.std}
    if feature.is_video:  # LeRobot has colors first, from 0 to 1
        values = {name: value.transpose(2, 0, 1) / 255 for name, value in values.items()}
    return {name: value.tolist() for name, value in values.items()} | {"count": [found.count]}
