"""Sets files aside that cannot be used: nothing is deleted that may still hold rows."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from physx_core import files

FOLDER = "damaged"


def set_aside(directory: Path, paths: Iterable[Path]) -> Path:
    """Move files, if they are there, to a folder of the dataset; return that folder."""
    folder = directory / FOLDER
    files.make_folder(folder)
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            files.rename(path, unused(folder / path.name))
    files.sync_folder(folder)
    files.sync_folder(directory)
    return folder


def keep(directory: Path, paths: Iterable[Path]) -> None:
    """Give files that are about to be replaced, if they are there, a second name in that folder."""
    folder = directory / FOLDER
    for path in paths:
        if path.exists():
            files.make_folder(folder)
            files.link(path, unused(folder / path.name))
            files.sync_folder(folder)


def unused(path: Path) -> Path:
    """Return a path that does not exist: the given one, or with a number appended."""
    found, number = path, 0
    while found.exists():
        number += 1
        found = path.with_name(f"{path.name}.{number}")
    return found
