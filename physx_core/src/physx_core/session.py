"""Session: the folder of a run, with its dataset, networks, statistics, and configuration."""

from __future__ import annotations

import datetime
import functools
import platform
import re
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from types import MappingProxyType
from typing import Any

from physx_core import files
from physx_core.config import read_toml
from physx_core.errors import SessionError, listed, nearest

NOTES = "Notes\n-----\n(Write here what this run is about; physx never changes these lines.)\n"


@dataclass(frozen=True)
class Session:
    """A session's folder.

    Attributes:
        path: The folder: ``<session_dir>/<session_name>``, later ones with ``_1``, ``_2``, ...
        is_new: Whether the folder was created for the current run.
    """

    path: Path
    is_new: bool = False

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.name

    @property
    def dataset_dir(self) -> Path:
        """Folder of the session's own dataset."""
        return self.path / "dataset"

    @property
    def network_dir(self) -> Path:
        """Folder of the session's checkpoints."""
        return self.path / "network"

    @property
    def stats_dir(self) -> Path:
        """Folder of the recorded statistics."""
        return self.path / "stats"

    @classmethod
    def create(
        cls, session_dir: str | Path, session_name: str, new_session: bool = True
    ) -> Session:
        """Create a session's folder.

        Args:
            session_dir: Folder of the sessions, relative to the working directory.
            session_name: Name of the session.
            new_session: Whether to create a numbered session if the name is taken; otherwise the
                existing one is used, with a warning if there is a newer one.

        Raises:
            SessionError: If the name is not a valid folder name, or the folder cannot be created.
        """
        if session_name in ("", "..") or Path(session_name).name != session_name:
            raise SessionError(f'"{session_name}" is not a valid session name.')
        root = Path(session_dir)
        path = root / session_name
        try:
            files.make_folder(root)
            if not new_session and path.is_dir():
                return cls.existing(root, session_name)
            if not new_session and _numbered(path):
                others = listed(other.name for other in _numbered(path))
                _warn(f'There is no session "{session_name}": using a new one, not {others}.')
            while True:
                try:
                    files.create_folder(path)
                    return cls(path, is_new=True)
                except FileExistsError:
                    path = root / f"{session_name}_{_last_number(root / session_name) + 1}"
        except OSError as error:
            raise SessionError(f"Cannot create the session folder {path}: {error}.") from error

    @classmethod
    def existing(cls, session_dir: str | Path, session_name: str) -> Session:
        """Return an existing session, and warn if a numbered one of the same name is newer.

        A script whose first run created the session "run" writes to "run_1" when started again.

        Raises:
            SessionError: If the session does not exist; the message lists the existing ones.
        """
        path = Path(session_dir) / session_name
        if not path.is_dir():
            root = Path(session_dir)
            names = [p.name for p in root.iterdir() if p.is_dir()] if root.is_dir() else []
            raise SessionError(
                f'There is no session "{session_name}" in {root}.'
                f"{nearest(session_name, names)} Available: {listed(names)}."
            )
        later = [other for other in _numbered(path) if _last_used(other) > _last_used(path)]
        if later:
            newest = max(later, key=_last_used)
            _warn(f'Using the session "{session_name}", but "{newest.name}" is newer.')
        return cls(path)

    def record(self, pipeline: str, plain: Mapping[str, Any], seed: int) -> None:
        """Write a run's configuration into ``config.toml`` and ``info.txt``.

        Args:
            pipeline: Name of the pipeline, the table in ``config.toml``.
            plain: Its configuration as plain data.
            seed: The seed of the run.

        Raises:
            SessionError: If the folder cannot be written to.
        """
        import tomli_w

        file, info = self.path / "config.toml", self.path / "info.txt"
        tables = read_toml(file) if file.exists() else {}
        try:
            files.replace(file, tomli_w.dumps({**tables, pipeline: plain}).encode())
            if not info.exists():
                info.write_text(f"Session {self.name}\n\n{NOTES}\n", encoding="utf-8")
        except OSError as error:
            reason = error.strerror or str(error)
            raise SessionError(
                f"The session {self.path} cannot be written to: {reason}."
            ) from error
        now = datetime.datetime.now(datetime.UTC).astimezone().isoformat(timespec="seconds")
        versions = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
        title = f"{pipeline}, {now}"
        lines = f"{title}\n{'-' * len(title)}\nseed: {seed}\n{versions}\n"
        self.note(f"{lines}\n{tomli_w.dumps(plain)}")

    def note(self, text: str) -> None:
        """Append a paragraph to ``info.txt``, where users may also write notes."""
        with (self.path / "info.txt").open("a", encoding="utf-8") as stream:
            stream.write(f"{text.rstrip()}\n\n")


def _warn(text: str) -> None:
    advice = (
        "If you mean another one, name it; in a script, pass on what the previous run created: "
        "DatasetConfig(existing_dir=generation.session.path), session_name=training.session.name."
    )
    warnings.warn(f"{text} {advice}", stacklevel=2)


def related_sessions(path: Path) -> list[Path]:
    """Return the sibling folders whose names differ from a session's only by number, sorted."""
    name = re.sub(r"_\d+$", "", path.name)
    base = path.with_name(name)
    return [other for other in (base, *_numbered(base)) if other.is_dir() and other != path]


def _numbered(path: Path) -> list[Path]:
    """Return the folders ``<path>_1``, ``<path>_2``, ... that exist, sorted by number."""
    found = (re.fullmatch(re.escape(path.name) + r"_(\d+)", p.name) for p in path.parent.iterdir())
    names = sorted((int(match[1]), match[0]) for match in found if match)
    return [path.with_name(name) for _, name in names]


def _last_used(path: Path) -> float:
    """Return the time at which a run last wrote its configuration to a session; 0: never."""
    file = path / "config.toml"
    return file.stat().st_mtime if file.is_file() else 0.0


def _last_number(path: Path) -> int:
    numbered = _numbered(path)
    return int(numbered[-1].name.rpartition("_")[2]) if numbered else 0


@functools.cache
def installed_versions() -> Mapping[str, str]:
    """Return the versions of Python, the platform, the physx distributions, and their libraries."""
    versions = {"python": platform.python_version(), "platform": sys.platform}
    for distribution in distributions():
        # From the folder's name, like importlib.metadata; reading all metadata is slow.
        name = getattr(distribution, "_normalized_name", None) or distribution.metadata["Name"]
        name = (name or "").replace("_", "-")
        if name.startswith("physx-") or name in ("numpy", "h5py", "torch", "dartpy", "pin"):
            versions[name] = distribution.version
    return MappingProxyType(dict(sorted(versions.items())))
