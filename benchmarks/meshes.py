"""Rows of any size against fixed rows of equal bytes: appending, and packed batches.

Claims: packed batches of rows of 12 kB on average, of 20 to 2000 entries of 12 B, come at 0.5 or
more of the speed of fixed rows of the same bytes in the same random order, from memory; of small
rows, of 1 to 100 entries, a row takes at most 1 microsecond more than its copy, as fixed rows; rows
are appended at 0.7 or more of the speed of fixed rows, to a partition that does not become full: to
seal one takes as long for both, at some time later. All in time of the processor, which other
programs hardly change.

    python benchmarks/meshes.py --check [--small]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from measure import claim, finish, rates, report

from physx_core import Dataset, Field, View
from physx_core.typing import Array, Batch

ENTRY = Field("x", ("node", 3), "float32")
BATCH = 64
LARGE = 5000  # bytes of a row
ROOM = 8.0  # GB of a partition, more than all rows


def sizes(count: int, least: int, most: int) -> Array:
    """Return numbers of entries."""
    return np.random.default_rng(0).integers(least, most + 1, count)


def block_of(counts: Array) -> Batch:
    """Return rows with these numbers of entries."""
    ends = np.cumsum(counts)
    values = np.random.default_rng(1).random((int(ends[-1]), 3), np.float32)
    return {"x": np.split(values, ends[:-1])}


def fixed_of(counts: Array) -> Batch:
    """Return as many fixed rows of the same mean size."""
    width = round(counts.mean())
    return {"x": np.random.default_rng(1).random((len(counts), width, 3), np.float32)}


def appending(root: Path, fields: list[Field], blocks: list[Batch]) -> Callable[[], Iterator[int]]:
    """Return work that appends blocks to a new dataset."""

    def work() -> Iterator[int]:
        with (
            tempfile.TemporaryDirectory(dir=root) as folder,
            Dataset.create(folder, max_file_size=ROOM) as dataset,
        ):
            dataset.define_fields("training", fields)
            yield 0
            for block in blocks:
                dataset.append("training", block)
            yield sum(len(block["x"]) for block in blocks)

    return work


def reading(dataset: Dataset, count: int) -> Callable[[], int]:
    """Return work that reads batches of a shuffled epoch, from memory, as trainings do."""
    batches = View(hold_back=False, order="exact").open(
        BATCH, data=dataset, fields=["x"], reuse=True
    )
    batches[0]

    def work() -> int:
        for number in range(count):
            batches[number]
        return count * BATCH

    return work


def measure(root: Path, count: int, least: int, most: int, rounds: int) -> list[bool]:
    """Measure rows with numbers of entries between two."""
    counts = sizes(count, least, most)
    free, fixed = block_of(counts), fixed_of(counts)
    shape = fixed["x"].shape[1:]
    nbytes = int(np.prod(shape)) * 4
    kinds = {"fixed": [Field("x", shape, "float32")], "free": [ENTRY]}
    step = max(1, 2**20 // nbytes)
    parts = {
        name: [{"x": rows["x"][first : first + step]} for first in range(0, count, step)]
        for name, rows in (("fixed", fixed), ("free", free))
    }
    work = {name: appending(root, kinds[name], parts[name]) for name in kinds}
    title = f"{count} rows of {nbytes / 1000:.3g} kB, {least} to {most} entries"
    measured = rates(work, rounds, time.process_time)
    target = 0.7 if nbytes > LARGE else 0.0
    met = [report(f"append: {title}", "rows", measured, "fixed", target, "free")]
    opened = {}
    for name, blocks in parts.items():
        with Dataset.create(root / f"{name}_{least}") as dataset:
            dataset.define_fields("training", kinds[name])
            for block in blocks:
                dataset.append("training", block)
        opened[name] = Dataset.open(root / f"{name}_{least}")
    measured = rates(
        {n: reading(d, count // BATCH) for n, d in opened.items()}, rounds, time.process_time
    )
    target = 0.5 if nbytes > LARGE else 0.0
    met.append(report(f"batches: {title}", "rows", measured, "fixed", target, "free"))
    if nbytes <= LARGE:
        fixed_s, free_s = (1e6 / statistics.median(measured[name]) for name in ("fixed", "free"))
        met.append(claim("microseconds a row above fixed rows", free_s - fixed_s, at_most=1.0))
    return met


def main() -> None:
    """Measure small and large rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="end with status 1 on a miss")
    parser.add_argument("--small", action="store_true", help="a quarter of the rows")
    small = parser.parse_args().small
    rounds = 3 if small else 7
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        met = measure(root, 6_400 if small else 25_600, 20, 2000, rounds)
        met += measure(root, 64_000, 1, 100, rounds)
    finish(met)


if __name__ == "__main__":
    main()
