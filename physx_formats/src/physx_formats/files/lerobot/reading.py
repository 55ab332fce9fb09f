"""Reads datasets in LeRobot's format, whoever wrote them.

Numbers of episodes and frames are the fields ``episode`` and ``step``. Features that physx has made
of several fields are those fields again.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import NUMBERS, Field, Role
from physx_core.parsing import parse_json
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.files.lerobot.features import VERSION
from physx_formats.files.lerobot.layout import video_file
from physx_formats.files.lerobot.video import Clip, Pictures, read_image
from physx_formats.files.sequential_rows import SequentialRows
from physx_formats.format import Columns
from physx_formats.table import Column, Notes, check_size, import_library

_NUMBERS = {"episode_index": "episode", "frame_index": "step"}
_INPUTS = ("observation", "action")
_MOST_TASKS = 4096
_Shape = tuple[int, ...]


def recognizes(path: Path, begin: bytes) -> bool:
    """Return whether a path is the folder of a LeRobot dataset."""
    return (path / "meta" / "info.json").is_file()


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[Columns, Notes]]:
    """Open a dataset; yield its fields by name, and what is known of them."""
    arrow = import_library("pyarrow", "Importing LeRobot datasets", "lerobot")
    source = _Source(path)
    columns = source.columns()
    sizes = (math.prod(each.shape) * each.dtype.itemsize for each in columns.values())
    check_size(path, sum(sizes), limit)
    try:
        yield columns, source.notes(columns)
    except (arrow.ArrowInvalid, OSError) as error:
        raise ExchangeError(f"{path} is damaged: {error}.") from error


class _Source:
    """A dataset's folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._arrow = import_library("pyarrow", "Importing LeRobot datasets", "lerobot")
        self._parquet = import_library("pyarrow.parquet", "Importing LeRobot datasets", "lerobot")
        place = path / "meta" / "info.json"
        try:
            info = parse_json(place.read_bytes())
            version, self._features, self._fps = (
                info["codebase_version"], dict(info["features"]), float(info["fps"])
            )  # fmt: skip
            self._written = Notes.parse(json.dumps(info.get("physx")))
            self._robot = str(info.get("robot_type"))
            if not self._fps > 0:
                raise ValueError(f"it has {self._fps} frames per second")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ExchangeError(f"{place} is damaged: {error!r:.200}") from error
        if version != VERSION:
            raise ExchangeError(
                f"{path} has the version {version!r:.20} of LeRobot's format, not {VERSION}. "
                "Convert it with LeRobot's own program convert_dataset_v21_to_v30."
            )
        files = sorted(path.glob("data/chunk-*/file-*.parquet"))
        self._files = [self._open(file) for file in files]
        if not files:
            raise ExchangeError(f"{path} has no files data/chunk-000/file-000.parquet.")

    def _open(self, file: Path) -> Any:
        try:
            return self._parquet.ParquetFile(file)
        except (self._arrow.ArrowInvalid, OSError) as error:
            raise ExchangeError(f"{file} is not a valid Parquet file: {error}.") from error

    def columns(self) -> dict[str, Column]:
        """Return the fields by name: all but texts."""
        found: dict[str, Column] = {}
        for name, described in self._features.items():
            try:
                for part, column in self._columns_of(name, described).items():
                    found.setdefault(part, column)
            except (KeyError, TypeError, ValueError) as error:
                raise ExchangeError(
                    f'The feature "{name}" of {self._path} is damaged: {error!r:.200}'
                ) from error
        return found

    def _columns_of(self, name: str, described: Mapping[str, Any]) -> dict[str, Column]:
        """Return the fields of a feature."""
        kind, shape = described["dtype"], tuple(int(size) for size in described["shape"])
        if min(shape, default=1) < 1:
            raise ValueError(f"it has the shape {shape}")
        parts = self._parts(name, described, shape)
        if kind == "video":
            return {part: self._pictures(name, described, shape) for part in parts}
        if kind == "image":
            size = _size_of(described, shape)
            return {part: _Images(self._files, name, (*size, 3)) for part in parts}
        if kind in ("string", "language"):
            warnings.warn(f'The feature "{name}" is left out: it is of type {kind}.', stacklevel=2)
            return {}
        columns: dict[str, Column] = {}
        begin, width = 0, math.prod(shape)
        for part, own in parts.items():
            end = begin + math.prod(own)
            place = begin, end, width
            columns[part] = _Numbers(self._files, name, np.dtype(kind), own, place)
            begin = end
        if parts and begin != width:
            raise ValueError(f"its fields have {begin} components of {width}")
        return columns

    def _parts(self, name: str, described: Mapping[str, Any], shape: _Shape) -> dict[str, _Shape]:
        """Return the shapes of the fields in a feature, by name."""
        if name in _NUMBERS:
            return {_NUMBERS[name]: ()}
        if self._written.modes:
            (fields,) = self._written.modes.values()
            return {part: tuple(fields[part].shape or ()) for part in described.get("fields", ())}
        return {} if name == "index" else {name: () if shape == (1,) else shape}

    def _pictures(self, name: str, described: Mapping[str, Any], shape: _Shape) -> Column:
        """Return the pictures of a feature in videos."""
        if Path(name).name != name:
            raise ValueError("its name is not that of a folder")
        size = _size_of(described, shape)
        keys = [f"videos/{name}/{key}" for key in ("chunk_index", "file_index", "from_timestamp")]
        wanted = ["episode_index", "length", *keys]
        rows: list[tuple[Any, ...]] = []
        for file in map(self._open, sorted(self._path.glob("meta/episodes/chunk-*/*.parquet"))):
            if set(wanted) - set(file.schema_arrow.names):
                raise ValueError(f"the episodes lack one of {wanted}")
            table = file.read(columns=wanted)
            rows += zip(*(table[key].to_pylist() for key in wanted), strict=True)
        clips = [
            Clip(video_file(self._path, name, int(chunk), int(number)), float(start), int(count))
            for _, count, chunk, number, start in sorted(rows)
        ]
        return Pictures(clips, (*size, 3), self._fps)

    def notes(self, columns: Mapping[str, Column]) -> Notes:
        """Return what is known of the fields."""
        if self._written.modes:
            return self._written
        fields = {}
        for name, column in columns.items():
            own = re.sub(r"\W", "_", name)
            role: Role = "training" if name.startswith(_INPUTS) else "additional"
            fields[own] = Field(own, column.shape[1:], column.dtype, role=role)
        info = {"fps": self._fps, "robot": self._robot, "tasks": self._tasks()}
        return Notes({"training": fields}, info)

    def _tasks(self) -> list[str]:
        """Return the descriptions of the tasks in order."""
        place = self._path / "meta" / "tasks.parquet"
        if not place.is_file():
            return []
        file = self._open(place)
        texts = [name for name in file.schema_arrow.names if name != "task_index"]
        if not texts or file.metadata.num_rows > _MOST_TASKS:
            return []
        return [str(text) for text in file.read(columns=texts[:1])[texts[0]].to_pylist()]


def _size_of(described: Mapping[str, Any], shape: _Shape) -> _Shape:
    """Return height and width of pictures; their shape may have the colors first."""
    if len(shape) != 3:
        raise ValueError(f"it has the shape {shape}")
    return shape[1:] if "channel" in str((described.get("names") or [""])[0]) else shape[:2]


class _Numbers(SequentialRows):
    """Components of a feature."""

    def __init__(
        self,
        files: Sequence[Any],
        name: str,
        dtype: np.dtype[Any],
        shape: _Shape,
        place: tuple[int, int, int],
    ) -> None:
        """Keep where they are: first component, the one after the last, and their number."""
        if dtype.kind not in NUMBERS:
            raise ValueError(f"it is of type {dtype}")
        super().__init__(files, name, dtype, shape)
        self._place = place

    def _values(self, array: Any) -> Array:
        begin, end, width = self._place
        rows = len(array)
        while hasattr(array, "flatten") and hasattr(array.type, "value_type"):
            array = array.flatten()
        values: Array = array.to_numpy(zero_copy_only=False)
        if array.null_count or values.size != rows * width or values.dtype != self.dtype:
            raise ExchangeError(
                f'"{self._name}" has rows of {values.size / max(rows, 1):g} values of '
                f"{values.dtype}, not of {width} of {self.dtype}, or without a value."
            )
        found: Array = values.reshape(rows, width)[:, begin:end]
        return found.reshape(rows, *self.shape[1:])


class _Images(SequentialRows):
    """Pictures that are files in the rows, such as PNG."""

    def __init__(self, files: Sequence[Any], name: str, shape: _Shape) -> None:
        super().__init__(files, name, np.dtype(np.uint8), shape)

    def _values(self, array: Any) -> Array:
        contents = array.field("bytes").to_pylist()
        found = np.empty((len(contents), *self.shape[1:]), self.dtype)
        for place, content in enumerate(contents):
            found[place] = read_image(f'"{self._name}"', content or b"", self.shape[1:])
        return found
