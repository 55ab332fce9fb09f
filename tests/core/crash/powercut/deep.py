"""What must be possible with a dataset after a power cut, besides reading it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from physx_core import Dataset, PhysxError
from powercut.promises import Seen, encode, look, read

FIRST_NEW = 300_000
"""A row that no history writes, small enough for every type."""
NEW = 3
SIZE = 2e-5


def examine(kind: str, folder: Path, seen: Seen) -> str:
    """Do something with a dataset that can be read; return what went wrong, or nothing.

    Args:
        kind: One of `KINDS`.
        folder: The dataset, which may be changed.
        seen: What was read of it.
    """
    try:
        problem = KINDS[kind](folder, seen)
    except PhysxError as error:
        problem = f"{type(error).__name__}: {error}"
    except Exception as error:
        problem = f"raw {type(error).__name__}: {error}"
    return problem and f"{kind}: {problem}"


def _verify(folder: Path, seen: Seen) -> str:
    """Only what was being written may be incomplete."""
    with Dataset.open(folder) as dataset:
        names = {
            part.file_name(of.name)
            for mode in dataset._manifest.modes.values()
            for part in mode.partitions
            if part.sealed
            for of in mode.fields.values()
        }
        for text in dataset.verify():
            if any(name in text for name in (*names, "statistics_")):
                return text
        return _statistics(dataset, seen)


def _statistics(dataset: Dataset, seen: Seen) -> str:
    """Compare the statistics with those of the rows."""
    for mode, values in seen.values.items():
        found = dataset.normalization_of(mode)
        for name, array in values.items():
            if array.dtype.kind != "f" or not len(array):
                continue
            if name not in found:
                return f"{mode}/{name} has no statistics"
            wanted = array.astype(np.float64).mean(axis=0)
            if not np.allclose(found[name].mean, wanted, rtol=1e-9):
                return f"the mean of {mode}/{name} is {found[name].mean}, not {wanted}"
    return ""


def _sound(folder: Path, wanted: Seen) -> str:
    """Compare what is there now with what must be, and verify it."""
    problem = wanted.difference(look(folder))
    if problem:
        return problem
    with Dataset.open(folder) as dataset:
        return "; ".join(dataset.verify()) or _statistics(dataset, wanted)


def _write(folder: Path, seen: Seen) -> str:
    """Open the dataset for writing, append to it, and read everything back."""
    with Dataset.open(folder, writable=True, max_file_size=SIZE) as dataset:
        problem = seen.difference(read(dataset)) or _statistics(dataset, seen)
        if problem:
            return f"opened for writing: {problem}"
        rows = np.arange(FIRST_NEW, FIRST_NEW + NEW)
        wanted = Seen(fields=seen.fields, info=seen.info)
        for mode, fields in seen.fields.items():
            if any(of.shape is None for of in fields.values()):
                wanted.values[mode] = seen.values[mode]
                continue
            block = {name: encode(of, rows, 0) for name, of in fields.items()}
            dataset.append(mode, block)
            wanted.values[mode] = {
                name: np.concatenate([values, block[name]])
                for name, values in seen.values[mode].items()
            }
        problem = wanted.difference(read(dataset))
        if problem:
            return f"after an append: {problem}"
    return _sound(folder, wanted)


def _repair(folder: Path, seen: Seen) -> str:
    """Repair the dataset: it has the same rows and no problems."""
    Dataset.repair(folder)
    return _sound(folder, seen)


def _rebuild(folder: Path, seen: Seen) -> str:
    """Rebuild the manifest: all rows are there, and perhaps some that were being removed."""
    Dataset.rebuild(folder)
    now = look(folder)
    if now.error or now.wrong:
        return now.error or now.wrong
    for mode in seen.fields:
        rows, found = seen.rows(mode), now.rows(mode)
        if not np.array_equal(found[np.isin(found, rows)], rows):
            return f"{mode}: {len(found)} rows are there, not all of the {len(rows)} before"
    with Dataset.open(folder) as dataset:
        return "; ".join(dataset.verify())


KINDS: dict[str, Callable[[Path, Seen], str]] = {
    "verify": _verify,
    "write": _write,
    "repair": _repair,
    "rebuild": _rebuild,
}
