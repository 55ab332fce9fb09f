"""Session: the folder of a run, with its dataset, networks, statistics and configuration."""

from __future__ import annotations

import datetime
import platform
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.config import read_toml
from physx_core.errors import SessionError, listed, nearest

NOTES = "Notes\n-----\n(Write here what this run is about; physx never changes these lines.)\n"


@dataclass(frozen=True)
class Session:
    """A session's folder.

    Attributes:
        path: The folder: ``<session_dir>/<session_name>``, with ``_1``, ``_2`` ... for later ones.
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
            new_session: Whether to number the new session if one of that name exists; otherwise the
                existing one is used.

        Raises:
            SessionError: If the name is not a valid folder name, or the folder cannot be created.
        """
        if session_name in ("", "..") or Path(session_name).name != session_name:
            raise SessionError(f'"{session_name}" is not a valid name of a session.')
        root = Path(session_dir)
        path = root / session_name
        try:
            files.make_folder(root)
            if not new_session and path.is_dir():
                return cls(path)
            while True:
                try:
                    files.create_folder(path)
                    return cls(path, is_new=True)
                except FileExistsError:
                    path = root / f"{session_name}_{_last_number(root, session_name) + 1}"
        except OSError as error:
            raise SessionError(f"Cannot create the session folder {path}: {error}.") from error

    @classmethod
    def existing(cls, session_dir: str | Path, session_name: str) -> Session:
        """Return an existing session.

        Raises:
            SessionError: If there is no such session; the message lists the existing ones.
        """
        path = Path(session_dir) / session_name
        if not path.is_dir():
            root = Path(session_dir)
            names = [p.name for p in root.iterdir() if p.is_dir()] if root.is_dir() else []
            raise SessionError(
                f'There is no session "{session_name}" in {root}.'
                f"{nearest(session_name, names)} There are: {listed(names)}."
            )
        return cls(path)

    def discard(self) -> None:
        """Remove the folder if it was created for the current run, which failed to start."""
        if self.is_new:
            shutil.rmtree(self.path, ignore_errors=True)

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
        """Append a paragraph to ``info.txt``, where the user may write notes too."""
        with (self.path / "info.txt").open("a", encoding="utf-8") as stream:
            stream.write(f"{text.rstrip()}\n\n")


def _last_number(root: Path, name: str) -> int:
    pattern = re.compile(re.escape(name) + r"_(\d+)")
    found = (pattern.fullmatch(path.name) for path in root.iterdir())
    return max((int(match[1]) for match in found if match), default=0)


def installed_versions() -> dict[str, str]:
    """Return the versions of Python, the platform, the physx distributions, and their libraries."""
    versions = {"python": platform.python_version(), "platform": sys.platform}
    for distribution in distributions():
        name = distribution.metadata["Name"] or ""
        if name.startswith("physx-") or name in ("numpy", "h5py", "torch", "dartpy", "pin"):
            versions[name] = distribution.version
    return dict(sorted(versions.items()))
