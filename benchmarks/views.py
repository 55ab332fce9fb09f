"""Views against what they are made of: windows, orders, the first batch, and a resumed training.

Claims: windows of 16 rows of 48 B come at 0.75 or more of the speed of aligned blocks of the same
bytes in the same random order; batches shuffled in blocks come at 0.8 or more of the speed of
those in the stored order, both from files in the system's cache; the first batch of 5 * 10^7 rows
comes within 0.3 s; a training that is resumed after 50 epochs reads no batch again and has its
first new one within a second; the means of batches from trajectories of 10^4 rows vary at most 1.4
times as much in blocks as in an exact order; the normalization of a fold of 10^6 stored rows in
episodes of 100 takes at most 10 ms.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from measure import claim, finish, rates, report

from physx_core import Batches, Dataset, DatasetConfig, NetworkConfig, Training, View
from physx_core.dataset import EpisodeRecord
from physx_core.dataset.read.access import memory

ROUNDS = 5


def store(folder: Path, count: int, width: int, steps: int) -> None:
    """Write rows of `width` random numbers in trajectories of `steps` rows."""
    rng, chunk = np.random.default_rng(0), 2**18
    with Dataset.create(folder) as dataset:
        for first in range(0, count, chunk):
            number = np.arange(first, min(first + chunk, count))
            dataset.append(
                "training",
                {
                    "x": rng.random((len(number), width)) + (number // steps % 7)[:, None],
                    "env_id": np.ones(len(number), np.int32),
                    "episode": number // steps,
                    "step": number % steps,
                },
            )


def reading(batches: Batches, count: int) -> Callable[[], int]:
    """Return work that reads some batches."""

    def read() -> int:
        for number in range(count):
            batches[number]
        return count

    return read


def windows(root: Path) -> bool:
    """Compare windows with aligned blocks of the same bytes."""
    store(root / "w", 400_000, 6, 1000)
    view = View(window={"x": ("x", list(range(16)))})
    with Dataset.open(root / "w") as dataset:
        aligned = dataset["training"]["x"][:].reshape(-1, 16 * 6)
    with view.open(256, data=root / "w", reuse=True) as batches:
        order = np.random.default_rng(0).permutation(len(aligned))
        out = np.empty((256, 16 * 6))

        def take() -> int:
            for start in range(0, 80 * 256, 256):
                aligned.take(order[start % 20_000 : start % 20_000 + 256], 0, out, "clip")
            return 80

        measured = rates({"aligned": take, "windows": reading(batches, 80)}, ROUNDS)
    return report("Windows of 16 rows of 48 B", "batches", measured, "aligned", 0.75, "windows")


def orders(root: Path, count: int) -> list[bool]:
    """Compare blocks with the stored order, and time the first batch."""
    store(root / "o", count, 3, 10_000)  # with the others 48 B
    found: dict[str, Any] = {}
    available, memory.available_memory = memory.available_memory, lambda: 0
    for order in ("stored", "blocks"):
        view = View(order=order, hold_back=False)
        batches = view.open(1024, data=root / "o", fields=["x"], reuse=True)
        found[order] = reading(batches, min(8000, len(batches)))
    met = [report("Rows of 48 B", "batches", rates(found, ROUNDS), "stored", 0.8, "blocks")]
    memory.available_memory = available
    for view in (View(hold_back=False), View()):
        firsts = []
        for seed in range(ROUNDS):
            began = time.perf_counter()
            with view.open(1024, seed, data=root / "o") as batches:
                batches[0]
            firsts.append(time.perf_counter() - began)
        what = f"seconds to the first batch of {count:,} rows of a stream, in the system's cache"
        what += ", a fifth held back" if view.hold_back else ""
        met.append(claim(what, statistics.median(firsts), at_most=0.3))
    seconds = [bare_pass(root / "o") for _ in range(ROUNDS)]
    print(f"  a bare pass that finds the trajectories of a stream: {min(seconds):.3g} s")
    return met


def bare_pass(folder: Path) -> float:
    """Return the time in s in which h5py and NumPy find where trajectories begin."""
    began, starts = time.perf_counter(), 0
    for place in sorted(folder.glob("*_step_*.h5")):
        different: Any = np.zeros(0, bool)
        for name, step in (("step", 1), ("episode", 0), ("env_id", 0)):
            with h5py.File(place.with_name(place.name.replace("_step_", f"_{name}_"))) as file:
                values = file["data"][:]
            changed = values[1:] != values[:-1] + values.dtype.type(step)
            different = changed if name == "step" else different | changed
        starts += int(different.sum())
    assert starts
    return time.perf_counter() - began


def spread(root: Path) -> bool:
    """Compare how the means of batches vary in blocks and in an exact order."""
    deviations = {}
    for order in ("exact", "blocks"):
        view = View(order=order, hold_back=False)
        with view.open(256, data=root / "o", fields=["x"]) as batches:
            means = [batch["x"].mean() for _, batch in zip(range(2000), batches, strict=False)]
        deviations[order] = float(np.std(means))
    what = "deviation of the means of batches in blocks, relative to an exact order"
    return claim(what, deviations["blocks"] / deviations["exact"], at_most=1.4)


def folds(root: Path) -> bool:
    """Time the normalization of a fold, each time in a dataset that was just opened."""
    steps, rng = 100, np.random.default_rng(0)
    with Dataset.create(root / "f") as dataset:
        for first in range(0, 10_000, 500):
            records = [EpisodeRecord(episode=first + k, rows=steps) for k in range(500)]
            rows = {"x": rng.random((500 * steps, 6))}
            dataset.append_episodes("training", rows, records)
    seconds = []
    for fold in range(ROUNDS):
        with View(folds=ROUNDS, fold=fold).open(256, data=root / "f") as batches:
            began = time.perf_counter()
            batches.normalization()
            seconds.append(time.perf_counter() - began)
    what = "milliseconds to the normalization of a fold of 10^6 rows in episodes of 100"
    return claim(what, statistics.median(seconds) * 1e3, at_most=10.0)


def resuming(root: Path) -> list[bool]:
    """Resume a training after 50 epochs."""
    store(root / "r", 20_000, 4, 100)

    class Counted(Training):
        """Notes when the first batch comes."""

        first = 0.0

        def batch_produce(self) -> None:
            super().batch_produce()
            self.first = self.first or time.perf_counter()

    numbers: list[int] = []
    get = Batches.__getitem__

    def noted(self: Batches, number: int) -> dict[str, np.ndarray]:
        numbers.append(number)
        return get(self, number)

    def train(epoch_nb: int, *, resume: bool) -> Counted:
        network = NetworkConfig("toy/linear", {"net_fields": "x", "opt_fields": "x"})
        config = DatasetConfig(existing_dir=str(root / "r"), view=View(hold_back=False))
        made = Counted(
            network, config, epoch_nb=epoch_nb, batch_size=100, seed=0, resume=resume, quiet=True,
            session_dir=str(root / "sessions"), session_name="run",
        )  # fmt: skip
        made.execute()
        return made

    train(50, resume=False)
    Batches.__getitem__ = noted  # type: ignore[method-assign]
    try:
        began = time.perf_counter()
        seconds = train(51, resume=True).first - began
    finally:
        Batches.__getitem__ = get  # type: ignore[method-assign]
    again = sum(number < 50 * 200 for number in numbers)
    return [
        claim("batches that are read again by a resume after 50 epochs", again, at_most=0),
        claim("seconds to its first new batch", seconds, at_most=1.0),
    ]


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the rows")
    rows = 5_000_000 if parser.parse_args().small else 50_000_000
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        root = Path(name)
        finish([windows(root), *orders(root, rows), spread(root), *resuming(root), folds(root)])


if __name__ == "__main__":
    main()
