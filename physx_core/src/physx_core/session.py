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

from physx_core.config import read_toml, write_toml
from physx_core.errors import SessionError, listed, nearest

NOTES = "Notes\n-----\n(Write here what this run is about; physx never changes these lines.)\n"


@dataclass(frozen=True)
class Session:
    """A session's folder.

    Attributes:
        path: The folder: ``<session_dir>/<session_name>``, with ``_1``, ``_2`` ... for later ones.
        is_new: Whether the folder was made for the present run.
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
        """Make a session's folder.

        Args:
            session_dir: Folder of the sessions, relative to the working directory.
            session_name: Name of the session.
            new_session: Whether an existing session of that name is left alone and a number is
                added to the new one's name; otherwise the existing one is used.

        Raises:
            SessionError: The name is no folder's name, or something else is in the way.
        """
        if session_name in ("", "..") or Path(session_name).name != session_name:
            raise SessionError(f'"{session_name}" cannot be the name of a session\'s folder.')
        root = Path(session_dir)
        path = root / session_name
        try:
            root.mkdir(parents=True, exist_ok=True)
            if not new_session and path.is_dir():
                return cls(path)
            while True:
                try:
                    path.mkdir()
                    return cls(path, is_new=True)
                except FileExistsError:
                    path = root / f"{session_name}_{_last_number(root, session_name) + 1}"
        except OSError as error:
            raise SessionError(f"Cannot make the session folder {path}: {error}.") from error

    @classmethod
    def existing(cls, session_dir: str | Path, session_name: str) -> Session:
        """Return a session that is there.

        Raises:
            SessionError: There is no such session; the message lists those that are there.
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
        """Remove the folder if it was made for the present run, which did not come to anything."""
        if self.is_new:
            shutil.rmtree(self.path, ignore_errors=True)

    def record(self, pipeline: str, plain: Mapping[str, Any], seed: int) -> None:
        """Write what a run is made from into ``config.toml`` and ``info.txt``.

        Args:
            pipeline: Name of the pipeline, the table in ``config.toml``.
            plain: Its configuration as plain data.
            seed: The seed that is used.
        """
        import tomli_w

        file = self.path / "config.toml"
        tables = read_toml(file) if file.exists() else {}
        write_toml(file, {**tables, pipeline: plain})
        info = self.path / "info.txt"
        if not info.exists():
            info.write_text(f"Session {self.name}\n\n{NOTES}\n", encoding="utf-8")
        now = datetime.datetime.now(datetime.UTC).astimezone().isoformat(timespec="seconds")
        versions = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
        title = f"{pipeline}, {now}"
        lines = f"{title}\n{'-' * len(title)}\nseed: {seed}\n{versions}\n"
        self.note(f"{lines}\n{tomli_w.dumps(plain)}")

    def note(self, text: str) -> None:
        """Add a paragraph to ``info.txt``; what stands there, notes of the user's too, stays."""
        with (self.path / "info.txt").open("a", encoding="utf-8") as stream:
            stream.write(f"{text.rstrip()}\n\n")


def _last_number(root: Path, name: str) -> int:
    pattern = re.compile(re.escape(name) + r"_(\d+)")
    found = (pattern.fullmatch(path.name) for path in root.iterdir())
    return max((int(match[1]) for match in found if match), default=0)


def installed_versions() -> dict[str, str]:
    """Return the versions of Python, NumPy, h5py and of all distributions of physx."""
    versions = {"python": platform.python_version(), "platform": sys.platform}
    for distribution in distributions():
        name = distribution.metadata["Name"] or ""
        if name.startswith("physx-") or name in ("numpy", "h5py", "torch", "dartpy", "pin"):
            versions[name] = distribution.version
    return dict(sorted(versions.items()))
