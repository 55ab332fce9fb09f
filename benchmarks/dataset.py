"""The dataset against the disk, tensors in RAM and h5py: all claims about its speed and size.

Rows of 48 B hold 6 numbers, rows of 48 kB hold 6000, as float64 in two fields. Each candidate runs
alternately with its baseline; torch has one thread.
"""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import torch
from measure import claim, finish, rates, report

from physx_core import Dataset

ROUNDS = 7
MODE = "training"
SMALL = {"x": (5,), "y": (1,)}
LARGE = {"x": (1000, 3), "y": (1000, 3)}
KINDS = {"48 B": SMALL, "48 kB": LARGE}

Shapes = dict[str, tuple[int, ...]]
Rows = dict[str, np.ndarray]
Work = Callable[[], int | Iterator[int]]


def random_rows(shapes: Shapes, count: int) -> Rows:
    """Return rows of random numbers."""
    rng = np.random.default_rng(0)
    return {name: rng.random((count, *shape)) for name, shape in shapes.items()}


def nbytes(rows: Rows) -> int:
    """Return the bytes of all values."""
    return sum(values.nbytes for values in rows.values())


def file_size(rows: Rows, partitions: int) -> float:
    """Return the size in GB of files that hold rows in a number of partitions."""
    count = -(-len(rows["x"]) // partitions)
    return 1e-9 * (max(values[:count].nbytes for values in rows.values()) + 2**14 + 1)


def in_new_folder(root: Path, work: Callable[[Path], Iterator[int]]) -> Work:
    """Return work that gets its own folder, which is removed afterwards."""
    numbers = itertools.count()

    def run() -> Iterator[int]:
        folder = root / f"{work.__name__}_{next(numbers)}"
        folder.mkdir()
        yield from work(folder)
        shutil.rmtree(folder)

    return run


# Writing ----------------------------------------------------------------------------------------


def appending_blocks(root: Path, title: str, target: float) -> bool:
    """Compare appending blocks of 2 MB, each committed, with `os.write` to as many files."""
    shapes, blocks = KINDS[title], 48
    rows = random_rows(shapes, 2**21 // nbytes(random_rows(shapes, 1)))

    def write(folder: Path) -> Iterator[int]:
        opened = [os.open(folder / name, os.O_WRONLY | os.O_CREAT) for name in rows]
        yield 0
        for _ in range(blocks):
            for descriptor, values in zip(opened, rows.values(), strict=True):
                os.write(descriptor, values.data.cast("B"))
        yield blocks * nbytes(rows)
        for descriptor in opened:
            os.close(descriptor)

    def append(folder: Path) -> Iterator[int]:
        with Dataset.create(folder) as dataset:
            dataset.append(MODE, {name: values[:1] for name, values in rows.items()})
            yield 0
            for _ in range(blocks):
                dataset.append(MODE, rows)
            yield blocks * nbytes(rows)

    candidates = {"os.write": in_new_folder(root, write), "append": in_new_folder(root, append)}
    measured = rates(candidates, ROUNDS)
    in_mb = {name: [rate / 1e6 for rate in each] for name, each in measured.items()}
    heading = f"Appending blocks of 2 MB, each committed, rows of {title}"
    return report(heading, "MB", in_mb, "os.write", target, "append")


def appending_samples(root: Path, title: str, target: float) -> bool:
    """Compare appending single samples with h5py's resize and assign."""
    shapes = KINDS[title]
    few, many = (200, 20_000) if title == "48 B" else (100, 1000)
    sample = {name: values[0] for name, values in random_rows(shapes, 1).items()}

    def resize_and_assign(folder: Path) -> Iterator[int]:
        with h5py.File(folder / "data.h5", "w") as file:
            for name, value in sample.items():
                file.create_dataset(name, (0, *value.shape), "f8", maxshape=(None, *value.shape))
            yield 0
            for row in range(few):
                for name, value in sample.items():
                    file[name].resize(row + 1, 0)
                    file[name][row] = value
            file.flush()
            yield few

    def append_sample(folder: Path) -> Iterator[int]:
        with Dataset.create(folder) as dataset:
            dataset.append_sample(MODE, sample)
            dataset.flush()
            yield 0
            for _ in range(many):
                dataset.append_sample(MODE, sample)
            dataset.flush()
            yield many

    works = (resize_and_assign, append_sample)
    measured = rates({work.__name__: in_new_folder(root, work) for work in works}, ROUNDS)
    heading = f"Appending sample by sample, rows of {title}"
    return report(heading, "samples", measured, "resize_and_assign", target, "append_sample")


# Random batches ---------------------------------------------------------------------------------


def in_ram(tensors: dict[str, torch.Tensor], size: int, batches: int) -> Work:
    """Return work that takes shuffled batches from tensors in RAM."""

    def index_select() -> int:
        given = 0
        while given < batches:
            order = torch.randperm(len(tensors["x"]))
            for chosen in order.split(size)[: batches - given]:
                _ = {
                    name: torch.index_select(tensor, 0, chosen) for name, tensor in tensors.items()
                }
                given += 1
        return batches

    return index_select


def from_dataset(dataset: Dataset, size: int, batches: int) -> Work:
    """Return work that reads shuffled batches from a dataset as tensors."""

    def read() -> int:
        found = dataset.batches(MODE, size, shuffle=True, seed=0, epochs=None, reuse=True)
        for batch in itertools.islice(found, batches):
            for values in batch.values():
                torch.from_numpy(values)
        return batches

    return read


def batches_against_ram(root: Path, title: str) -> list[bool]:
    """Compare batches of 32, 256 and 1024 rows with `torch.index_select`."""
    count = 400_000 if title == "48 B" else 2048
    rows, met = random_rows(KINDS[title], count), []
    tensors = {name: torch.from_numpy(values) for name, values in rows.items()}
    for partitions in (1, 64):
        folder = root / f"batches_{title}_{partitions}"
        with Dataset.create(folder, max_file_size=file_size(rows, partitions)) as dataset:
            dataset.append(MODE, rows)
            partitions = dataset.describe()[0]["partitions"]
        with Dataset.open(folder) as dataset:
            for size in (32, 256, 1024):
                batches = min(2000, max(120, 2 * count // size))
                candidates = {
                    "index_select": in_ram(tensors, size, batches),
                    "dataset": from_dataset(dataset, size, batches),
                }
                target = 0.7 if (size, title) == (32, "48 B") else 0.9
                heading = f"Batches of {size} rows of {title}, {partitions} partitions"
                measured = rates(candidates, ROUNDS)
                met.append(report(heading, "batches", measured, "index_select", target, "dataset"))
    return met


def batches_against_h5py(root: Path, title: str) -> bool:
    """Compare batches of 256 rows with h5py's sorted fancy indexing of a chunked file."""
    path, size, few = root / f"chunked_{title}.h5", 256, 3
    with Dataset.open(root / f"batches_{title}_64") as dataset:
        count = dataset.num_samples(MODE)
        with h5py.File(path, "w") as file:
            for name in dataset.fields(MODE):
                file.create_dataset(name, data=dataset[MODE][name][:], chunks=True)
        with h5py.File(path) as file:

            def fancy() -> int:
                order = np.random.default_rng().permutation(count)
                for start in range(0, few * size, size):
                    chosen = np.sort(order[start : start + size])
                    for name in file:
                        torch.from_numpy(file[name][chosen])
                return few

            candidates = {"h5py": fancy, "dataset": from_dataset(dataset, size, 100)}
            measured = rates(candidates, ROUNDS)
    heading = f"Batches of {size} rows of {title}, h5py chunked"
    return report(heading, "batches", measured, "h5py", 30, "dataset")


# Size and opening -------------------------------------------------------------------------------


def disk_usage(folder: Path) -> int:
    """Return the bytes that the files of a folder take on the disk."""
    return sum(path.stat().st_blocks * 512 for path in folder.iterdir())


def opening_and_size(root: Path) -> list[bool]:
    """Open 64 partitions with 10 million rows, and compare their size with the raw bytes."""
    folder, count, met = root / "many", 10_000_000, []
    block = random_rows(SMALL, count // 64)
    row_nbytes = nbytes(block) // len(block["x"])
    with Dataset.create(folder, max_file_size=file_size(block, 1)) as dataset:
        for _ in range(64):
            dataset.append(MODE, block)
        partitions = dataset.describe()[0]["partitions"]
    paths = sorted(folder.glob(f"run_{MODE}_*.h5"))

    def with_h5py() -> int:
        for path in paths:
            with h5py.File(path) as file:
                _ = file["data"].shape
        return 1

    def with_physx() -> int:
        with Dataset.open(folder) as dataset:
            _ = dataset.num_samples(MODE)
        return 1

    def with_physx_and_rows() -> int:
        with Dataset.open(folder) as dataset:
            for field in dataset.fields(MODE):
                _ = dataset[MODE][field][[0, -1]]
        return 1

    candidates = {
        "every file with h5py": with_h5py,
        "dataset": with_physx,
        "dataset, all files mapped": with_physx_and_rows,
    }
    measured = rates(candidates, ROUNDS)
    heading = (
        f"Opening {partitions} partitions, {count:,} rows; 1.5 times as long is a ratio of 0.67"
    )
    of = ("dataset", "dataset, all files mapped")
    met.append(report(heading, "times", measured, "every file with h5py", 1 / 1.5, *of))
    print("Bytes on the disk by the raw bytes")
    met.append(claim("rows of 48 B", disk_usage(folder) / (count * row_nbytes), at_most=1.02))
    rows = random_rows({"x": (3000,), "y": (3,)}, 4096)
    with Dataset.create(root / "wide") as dataset:
        dataset.append(MODE, rows)
    met.append(claim("rows of 24 kB", disk_usage(root / "wide") / nbytes(rows), at_most=1.02))
    return met


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        root, met = Path(name), []
        for title, target in (("48 B", 0.5), ("48 kB", 0.8)):
            met.append(appending_blocks(root, title, target))
        for title, target in (("48 B", 50), ("48 kB", 8)):
            met.append(appending_samples(root, title, target))
        for title in KINDS:
            met += batches_against_ram(root, title)
            met.append(batches_against_h5py(root, title))
        met += opening_and_size(root)
    finish(met)


if __name__ == "__main__":
    main()
