"""Training on a dataset twice as large as the memory that the process may use.

The training runs in its own process, whose control group limits its memory, including the file
cache, to half of the dataset's size. If no control group can be created, the only limit is that the
file cache is emptied before each round, and that physx is told that no memory is free.

Claims: shuffled batches are read at 0.8 or more of the speed at which the same files are read
sequentially under the same limit; a small network trains on them at 0.5 or more of that speed
with rows of 48 B, which are shuffled in blocks, and at 0.7 or more with rows of 48 kB, which are
shuffled exactly; and the process grows by no more than the two windows of 16 MB in which rows are
shuffled.

What can be had without physx is printed beside it: a bare loop over the same files, which reads
blocks of 64 kB in a random order, one window ahead in a thread, and takes the rows of a window in
an order that it is given, or reads rows of 48 kB where they belong in a batch, announced to the
system 8 MB ahead; and the training's steps alone, on a batch that is in memory.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from measure import claim, finish, rates, report

from physx_core import Dataset
from physx_core.dataset.read.access import memory

LIMIT = 384 * 2**20
ROUNDS = 7
GROWTH = 48
HEADER, WINDOW = 4096, 256
CASES = {
    "rows of 48 B": ({"x": (5,), "y": (1,)}, 4096, "blocks", 0.5),
    "rows of 48 kB": ({"x": (1000, 3), "y": (1000, 3)}, 32, "exact", 0.7),
}


def store(folder: Path, shapes: dict[str, tuple[int, ...]], size: int) -> None:
    """Write a dataset of random numbers with `size` bytes of rows."""
    rng = np.random.default_rng(0)
    row_nbytes = sum(8 * int(np.prod(shape)) for shape in shapes.values())
    count = 2**24 // row_nbytes
    with Dataset.create(folder, max_file_size=0.064) as dataset:
        for _ in range(size // (count * row_nbytes)):
            rows = {name: rng.random((count, *shape)) for name, shape in shapes.items()}
            dataset.append("training", rows)


def files(folder: Path, field: str = "") -> list[Path]:
    """Return the partition files, of one field."""
    return sorted(folder.glob(f"*_training_{field}*.h5"))


def forget(folder: Path) -> None:
    """Drop the files from the file cache."""
    for path in files(folder):
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def sequential(folder: Path) -> Callable[[], int]:
    """Return a round that reads all files from beginning to end."""
    buffer = memoryview(bytearray(2**23))

    def read() -> int:
        forget(folder)
        total = 0
        for path in files(folder):
            descriptor = os.open(path, os.O_RDONLY)
            while count := os.readv(descriptor, [buffer]):
                total += count
            os.close(descriptor)
        return total

    return read


def shuffled(dataset: Dataset, batch_size: int, learn: Callable[..., None]) -> Callable[[], int]:
    """Return a round of one shuffled epoch."""

    def epoch() -> int:
        forget(dataset.directory)
        total = 0
        for batch in dataset.batches("training", batch_size, shuffle=True, seed=0, reuse=True):
            learn(**batch)
            total += sum(values.nbytes for values in batch.values())
        return total

    return epoch


def bare_blocks(folder: Path, row_nbytes: Sequence[int], batch_size: int) -> Callable[[], int]:
    """Return a round of one epoch in blocks of 64 kB and windows of 256, without physx."""
    block, rng = 2**16 // sum(row_nbytes), np.random.default_rng(0)
    columns = [files(folder, field) for field in ("x", "y")]
    places = [
        (number, row)
        for number, path in enumerate(columns[0])
        for row in range(0, (path.stat().st_size - HEADER) // row_nbytes[0] - block, block)
    ]
    within = rng.permutation(WINDOW * block)

    def read(chosen: Sequence[int]) -> list[np.ndarray]:
        window = [np.empty((len(chosen) * block, n), np.uint8) for n in row_nbytes]
        for slot, (number, row) in enumerate(places[each] for each in chosen):
            for paths, values, nbytes in zip(columns, window, row_nbytes, strict=True):
                descriptor = os.open(paths[number], os.O_RDONLY)
                out = values[slot * block : (slot + 1) * block]
                os.preadv(descriptor, [memoryview(out).cast("B")], HEADER + row * nbytes)
                os.close(descriptor)
        return window

    def epoch() -> int:
        forget(folder)
        order = rng.permutation(len(places)).tolist()
        pieces = [order[start : start + WINDOW] for start in range(0, len(order), WINDOW)]
        outs, total = [np.empty((batch_size, n), np.uint8) for n in row_nbytes], 0
        with ThreadPoolExecutor(1) as helper:
            coming = helper.submit(read, pieces[0])
            for following in [*pieces[1:], []]:
                window, coming = coming.result(), helper.submit(read, following)
                rows = within[within < len(window[0])] if len(window[0]) < len(within) else within
                for start in range(0, len(rows) - batch_size + 1, batch_size):
                    for values, out, n in zip(window, outs, row_nbytes, strict=True):
                        kind = f"V{n}"
                        index = rows[start : start + batch_size]
                        np.take(values.view(kind), index, 0, out.view(kind), "clip")
                    total += sum(out.nbytes for out in outs)
        return total

    return epoch


def bare_rows(folder: Path, row_nbytes: Sequence[int], batch_size: int) -> Callable[[], int]:
    """Return a round of one epoch of single rows in a random order, without physx."""
    columns = [[os.open(path, os.O_RDONLY) for path in files(folder, f)] for f in ("x", "y")]
    places = [
        (number, HEADER + row)
        for number, descriptor in enumerate(columns[0])
        for row in range(0, os.fstat(descriptor).st_size - HEADER, row_nbytes[0])
    ]
    ahead = 2**23 // sum(row_nbytes)

    def epoch() -> int:
        forget(folder)
        order, total = np.random.default_rng(0).permutation(len(places)).tolist(), 0
        outs = [memoryview(bytearray(batch_size * n)) for n in row_nbytes]
        for turn, chosen in enumerate(order):
            if turn % ahead == 0:
                for each in order[turn + ahead * (turn > 0) : turn + 2 * ahead]:
                    number, at = places[each]
                    for column, n in zip(columns, row_nbytes, strict=True):
                        os.posix_fadvise(column[number], at, n, os.POSIX_FADV_WILLNEED)
            (number, at), slot = places[chosen], turn % batch_size
            for column, out, n in zip(columns, outs, row_nbytes, strict=True):
                total += os.preadv(column[number], [out[slot * n : (slot + 1) * n]], at)
        return total

    return epoch


def steps_alone(
    shapes: Mapping[str, tuple[int, ...]], batch_size: int, learn: Callable[..., None]
) -> Callable[[], int]:
    """Return a round of a training's steps on one batch."""
    batch = {name: np.random.default_rng(0).random((batch_size, *s)) for name, s in shapes.items()}
    nbytes = sum(values.nbytes for values in batch.values())

    def steps() -> int:
        for _ in range(2 * LIMIT // nbytes):
            learn(**batch)
        return 2 * LIMIT // nbytes * nbytes

    return steps


def trainer(x_shape: tuple[int, ...], y_shape: tuple[int, ...]) -> Callable[..., None]:
    """Return a function that makes one optimization step of a small linear network."""
    size = min(64, int(np.prod(x_shape)))
    layer = torch.nn.Linear(size, y_shape[-1], dtype=torch.float64)
    optimizer = torch.optim.SGD(layer.parameters(), lr=1e-3)

    def learn(x: np.ndarray, y: np.ndarray) -> None:
        inputs = torch.from_numpy(x).reshape(len(x), -1)[:, :size]
        targets = torch.from_numpy(y).reshape(len(y), -1)[:, : y_shape[-1]]
        loss = torch.nn.functional.mse_loss(layer(inputs), targets)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    return learn


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def measure(root: Path, limited: bool) -> None:
    """Measure and print, in the process with the limit."""
    torch.set_num_threads(1)
    met = []
    if not limited:
        memory.available_memory = lambda: 0
    for number, (title, (shapes, batch_size, expected, target)) in enumerate(CASES.items()):
        folder = root / str(number)
        with Dataset.open(folder) as dataset:
            chosen = dataset.default_order("training")
            step = trainer(*shapes.values())
            sizes: list[int] = []

            def epoch(train: Callable[[], int], sizes: list[int] = sizes) -> Callable[[], int]:
                def run() -> int:
                    total = train()
                    sizes.append(resident())
                    return total

                return run

            bare = bare_blocks if chosen == "blocks" else bare_rows
            nbytes = [8 * int(np.prod(shape)) for shape in shapes.values()]
            candidates = {
                "sequential read": sequential(folder),
                "bare loop": bare(folder, nbytes, batch_size),
                "steps alone": steps_alone(shapes, batch_size, step),
                "batches": epoch(shuffled(dataset, batch_size, lambda **_: None)),
                "training": epoch(shuffled(dataset, batch_size, step)),
            }
            measured = rates(candidates, ROUNDS)
        count = sum(path.stat().st_size for path in files(folder))
        heading = f"{title}, batches of {batch_size}, {count / 2**20:.0f} MiB: {chosen}"
        in_mb = {name: [rate / 1e6 for rate in each] for name, each in measured.items()}
        met.append(report(heading, "MB", in_mb, "sequential read", 0.8, "batches"))
        met.append(report("A training on them", "MB", in_mb, "sequential read", target, "training"))
        growth = (max(sizes[2:]) - sizes[1]) / 2**20
        what = f"growth of the process after the first round, at {sizes[1] / 2**20:.0f} MiB, in MiB"
        met.append(claim(what, growth, at_most=GROWTH) and chosen == expected)
    finish(met)


@contextlib.contextmanager
def control_group(limit: int) -> Iterator[Path | None]:
    """Create a control group within that of this process; yield None if that is not allowed."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        group = Path("/sys/fs/cgroup", controllers, path.lstrip("/"), f"physx_{os.getpid()}")
        name = "memory.limit_in_bytes" if controllers else "memory.max"
        try:
            group.mkdir()
        except OSError:
            continue
        try:
            (group / name).write_text(str(limit))
            yield group
            return
        except OSError:
            continue
        finally:
            group.rmdir()
    yield None


def main() -> None:
    """Write the datasets and start the process that reads them."""
    if "--worker" in sys.argv:
        root, limited = sys.argv[-2:]
        measure(Path(root), limited == "limited")
        return
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name, control_group(LIMIT) as group:
        for number, (shapes, *_) in enumerate(CASES.values()):
            store(Path(name, str(number)), shapes, 2 * LIMIT)

        def enter() -> None:
            if group is not None:
                (group / "cgroup.procs").write_text(str(os.getpid()))

        how = "limited" if group is not None else "unlimited"
        print(f"memory limit {LIMIT / 2**20:.0f} MiB: {'control group' if group else 'none'}\n")
        words = [sys.executable, __file__, *sys.argv[1:], "--worker", name, how]
        status = subprocess.run(words, preexec_fn=enter, check=False).returncode
    sys.exit(status)


if __name__ == "__main__":
    main()
