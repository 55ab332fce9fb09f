"""Sets unusable files aside: nothing that may still hold rows is deleted."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from physx_core import files

FOLDER = "damaged"


def set_aside(directory: Path, paths: Iterable[Path]) -> Path:
    """Move files, if they exist, to the folder of damaged files; return that folder."""
    folder = directory / FOLDER
    files.make_folder(folder)
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            files.rename(path, unused(folder / path.name))
    files.sync_folder(folder)
    files.sync_folder(directory)
    return folder


def keep(directory: Path, paths: Iterable[Path]) -> None:
    """Hard-link files that are about to be replaced, if they exist, into that folder."""
    folder = directory / FOLDER
    for path in paths:
        if path.exists():
            files.make_folder(folder)
            files.link(path, unused(folder / path.name))
            files.sync_folder(folder)


def unused(path: Path) -> Path:
    """Return an unused path: the given one, or that with a number appended."""
    found, number = path, 0
    while found.exists():
        number += 1
        found = path.with_name(f"{path.name}.{number}")
    return found
