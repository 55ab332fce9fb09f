"""Format: a file format that datasets are exported to or imported from."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from physx_core import plugins
from physx_formats.table import Column, ExportOptions, Notes, Table

KIND = "format"
"""The kind of component."""
Columns: TypeAlias = dict[str, Column]

LOSSES = {
    "units": "keeps no units",
    "types": (
        "keeps no types: numbers are int64, float64 or bool again, with the same values, and so is "
        "text that looks like them"
    ),
    "notes": "keeps no roles and axes of fields, nor which are the same quantity",
    "colors": "keeps pictures that are observations as videos, whose colors are only close",
    "records": "keeps no records of episodes, with their parameters",
    "way back": "is not imported",
}
"""What a format may not keep, as the predicate of its name."""


def _never(path: Path, begin: bytes) -> bool:
    """Recognize nothing."""
    return False


@dataclass(frozen=True)
class Format:
    """A format that datasets can be exported to or imported from; a plugin's component.

    Attributes:
        write: Writes tables to a path that does not exist; returns the number of rows left out.
            None: nothing can be exported to it.
        compressions: Names of its compressions, "none" first.
        several: Whether one file can hold several modes.
        options: Names of the episode options that it takes: see `ExportOptions`.
        free_axes: Whether it holds rows of any size.
        text: Whether it holds text.
        loses: What it does not keep, of `LOSSES`; all else comes back as it was.
        recognizes: Returns whether a path is a file or folder of this format, from its first 8
            bytes; those of a folder are empty. File names do not matter.
        open: Opens a file that holds at most this number of bytes, and yields its arrays by name,
            and the notes in it; raises ExchangeError for a damaged file. None: nothing can be
            imported from it.
    """

    write: Callable[[Sequence[Table], Path, ExportOptions], int] | None = None
    compressions: Collection[str] = ("none",)
    several: bool = False
    options: Collection[str] = ()
    free_axes: bool = False
    text: bool = False
    loses: Collection[str] = ()
    recognizes: Callable[[Path, bytes], bool] = _never
    open: Callable[[Path, int], AbstractContextManager[tuple[Columns, Notes]]] | None = None


def find_format(name: str) -> Format:
    """Return a format by its name, such as ``npz``, or by reference, such as ``mine/columns``.

    Raises:
        ComponentNotFoundError: If no plugin has a format of that name.
        ReferenceFormError: If several have.
        PluginError: If the plugin is broken.
    """
    found: Format = plugins.resolve(KIND, plugins.complete_reference(KIND, name))
    return found


def all_formats() -> dict[str, Format]:
    """Return the formats of all plugins by name; broken ones are left out."""
    found: dict[str, Format] = {}
    for reference, each in plugins.resolve_all(KIND).items():
        found.setdefault(reference.partition("/")[2], each)
    return found
