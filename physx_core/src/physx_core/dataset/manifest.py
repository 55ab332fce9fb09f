"""The manifest ``dataset.json``: fields, partitions, normalization and what the data came from."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import files
from physx_core.dataset.layout import Identity, partition_file
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import Field
from physx_core.statistics import RunningStatistics

FILE = "dataset.json"
FORMAT = "physx dataset"
VERSION = 1


@dataclass
class Partition:
    """Consecutive rows of one mode: one file for each field.

    Attributes:
        session: Session that wrote it.
        index: Its number in the session and mode, counted from 0.
        first_row: Row of the mode that is its first.
        rows: Committed rows, the same in all fields.
        sealed: Whether it is complete: every file has exactly these rows and never changes again.
        offsets: Place of the first row in the file, by field.
        checksums: CRC-32 of the rows, by field; empty until it is sealed.
        writing: Whether this process writes it, so that `offsets` are right though not sealed.
    """

    session: str
    index: int
    first_row: int
    rows: int = 0
    sealed: bool = False
    offsets: dict[str, int] = field(default_factory=dict)
    checksums: dict[str, int] = field(default_factory=dict)
    writing: bool = False

    def file_name(self, mode: str, name: str) -> str:
        """Return the name of a field's file."""
        return partition_file(self.session, mode, name, self.index)

    def identity(self, mode: str, of: Field) -> Identity:
        """Return what a field's file is part of."""
        return Identity(self.session, mode, of, self.index, self.first_row)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; an unfinished partition's rows are only in its files."""
        plain: dict[str, Any] = {
            "session": self.session,
            "index": self.index,
            "first_row": self.first_row,
            "sealed": self.sealed,
            "offsets": self.offsets,
        }
        if self.sealed:
            crc32 = {name: f"{value:08x}" for name, value in self.checksums.items()}
            plain |= {"rows": self.rows, "crc32": crc32}
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Partition:
        """Make what `to_dict` described."""
        return cls(
            session=str(plain["session"]),
            index=int(plain["index"]),
            first_row=int(plain["first_row"]),
            rows=int(plain.get("rows", 0)),
            sealed=bool(plain["sealed"]),
            offsets={name: int(offset) for name, offset in plain["offsets"].items()},
            checksums={name: int(crc, 16) for name, crc in plain.get("crc32", {}).items()},
        )


@dataclass
class Mode:
    """The rows of one mode.

    Attributes:
        fields: The fields by name; shapes are None until the first rows tell them.
        partitions: In the order of the rows.
        statistics: Mean and deviation of floating fields; each covers the first rows of the mode,
            as many as its count says.
    """

    fields: dict[str, Field]
    partitions: list[Partition] = field(default_factory=list)
    statistics: dict[str, RunningStatistics] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Committed rows."""
        return sum(partition.rows for partition in self.partitions)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "fields": [of.to_dict() for of in self.fields.values()],
            "partitions": [partition.to_dict() for partition in self.partitions],
            "normalization": {name: s.to_dict() for name, s in self.statistics.items() if s.count},
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Mode:
        """Make what `to_dict` described."""
        fields = [Field.from_dict(of) for of in plain["fields"]]
        statistics = plain.get("normalization", {})
        return cls(
            {of.name: of for of in fields},
            [Partition.from_dict(partition) for partition in plain["partitions"]],
            {name: RunningStatistics.from_dict(values) for name, values in statistics.items()},
        )


def versions() -> dict[str, str]:
    """Return the versions of what writes datasets."""
    packages = ("physx-core", "numpy", "h5py")
    return {"python": platform.python_version()} | {
        package: metadata.version(package) for package in packages
    }


@dataclass
class Manifest:
    """Everything that a dataset knows besides its rows.

    Attributes:
        modes: The modes by name.
        info: Where the data came from: environment, its keyword arguments, seed and the like.
        versions: Versions of Python and of the packages that made the dataset.
        problems: Modes whose rows cannot be counted, and why; not stored.
    """

    modes: dict[str, Mode] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=versions)
    problems: dict[str, DatasetError] = field(default_factory=dict)

    @property
    def sessions(self) -> list[str]:
        """Names of the sessions that wrote rows, in their order."""
        found = [p.session for mode in self.modes.values() for p in mode.partitions]
        return list(dict.fromkeys(found))

    @property
    def file_names(self) -> set[str]:
        """Names of all partition files."""
        return {
            partition.file_name(name, of)
            for name, mode in self.modes.items()
            for partition in mode.partitions
            for of in mode.fields
        }

    def save(self, directory: Path) -> None:
        """Write the file; a reader finds the old or the new one, whole.

        Raises:
            OSError: It cannot be written; the old one is still there.
        """
        plain = {
            "format": FORMAT,
            "format_version": VERSION,
            "versions": self.versions,
            "info": self.info,
            "modes": {name: mode.to_dict() for name, mode in self.modes.items()},
        }
        files.replace(directory / FILE, json.dumps(plain, indent=1).encode())

    @classmethod
    def load(cls, directory: Path) -> Manifest:
        """Read the file.

        Raises:
            FileNotFoundError: There is none.
            DatasetError: It is not the manifest of a dataset.
        """
        path = directory / FILE
        try:
            plain = json.loads(path.read_text(encoding="utf-8"))
            if plain["format"] != FORMAT or plain["format_version"] > VERSION:
                raise ValueError(f"{plain['format']!r} version {plain['format_version']!r}")
            modes = {name: Mode.from_dict(mode) for name, mode in plain["modes"].items()}
            return cls(modes, dict(plain["info"]), dict(plain["versions"]))
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError) as error:
            raise DatasetError(
                f"{path} ({path.stat().st_size} bytes) is not the manifest of a dataset that this "
                f"version reads: {error!r}. Delete or rename it, and everything but the info is "
                "rebuilt from the partition files; no row is lost."
            ) from error
        except FileNotFoundError:
            raise
        except OSError as error:
            raise DatasetError(f"{path} cannot be read: {error.strerror}.") from error


def plain_info(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as the manifest will give them back: tuples and arrays become lists.

    Raises:
        ConfigError: A value is nothing that JSON can hold.
    """

    def convert(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        if isinstance(value, type):
            return f"{value.__module__}:{value.__qualname__}"
        raise TypeError(f"{value!r} is nothing that JSON can hold")

    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(values), default=convert))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"The dataset's info cannot be stored: {error}.") from error
    return plain
