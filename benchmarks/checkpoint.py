"""Saving a checkpoint against writing the same bytes to files and waiting for the disk.

A numbered checkpoint has 10 MB: a network's parameters and the state of its optimizer. The best
checkpoint has 10 MB of parameters and replaces the previous one. The baseline writes the same
files, each with one `os.write` and one `os.fsync`, and removes the previous ones where the best
checkpoint is replaced; it does not make the names of folders durable. Both run alternately, on the
same disk.

    python benchmarks/checkpoint.py
    python benchmarks/checkpoint.py --check     # ends with status 1 if a target is missed
"""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from measure import finish, rates, report

from physx_core import Field, NetworkConfig, checkpoint
from physx_core.pipelines import Learner

ROUNDS = 30
SAVES = 2
TARGET = 1.5
KINDS = {
    "a numbered checkpoint": (False, [256, 700, 700, 256]),
    "the best network": (True, [256, 1340, 1340, 256]),
}
PROGRESS = checkpoint.Progress(epoch=1, batch=0, batches_read=1, seed=0)


def trained(layers: list[int]) -> Learner:
    """Return a network whose optimizer has made a step."""
    config = NetworkConfig(
        "torch/fc",
        {"layers": layers, "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="Adam",
    )
    learner = Learner(config, trains=True)
    learner.bind({name: Field(name, (256,), "float32") for name in ("x", "y")}, {})
    batch = {name: torch.ones(4, 256).numpy() for name in ("x", "y")}
    learner.optimize(batch)
    return learner


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of the files in a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def plain_writes(
    root: Path, written: dict[str, bytes], *, best: bool
) -> Callable[[], Iterator[int]]:
    """Return work that writes files to new folders and waits for the disk.

    Args:
        root: Parent of these folders.
        written: Contents of the files, by name.
        best: Whether each folder is removed when the next one is written.
    """
    numbers = itertools.count(1)

    def run() -> Iterator[int]:
        first = next(numbers) * SAVES
        yield 0
        for number in range(first, first + SAVES):
            folder = root / f"plain_{number}"
            folder.mkdir()
            for name, content in written.items():
                descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT)
                os.write(descriptor, content)
                os.fsync(descriptor)
                os.close(descriptor)
            if best:
                shutil.rmtree(root / f"plain_{number - 1}", ignore_errors=True)
        yield SAVES
        if not best:
            for number in range(first, first + SAVES):
                shutil.rmtree(root / f"plain_{number}")

    return run


def saves(root: Path, learner: Learner, *, best: bool) -> Callable[[], Iterator[int]]:
    """Return work that saves checkpoints: numbered ones, or the best one again and again."""
    folder = root / "network"

    def run() -> Iterator[int]:
        yield 0
        paths = [learner.save(folder, PROGRESS, best=best) for _ in range(SAVES)]
        yield SAVES
        if not best:
            number = int(paths[0].name.rpartition("_")[2])
            for earlier in range(number - 1, number + SAVES - 1):  # the last one stays
                shutil.rmtree(folder / f"network_{earlier}")

    return run


def main() -> None:
    """Print the claims."""
    torch.set_num_threads(1)
    met = []
    with tempfile.TemporaryDirectory(dir=".") as name:
        root = Path(name)
        for kind, (best, layers) in KINDS.items():
            learner = trained(layers)
            written = contents(learner.save(root / "network", PROGRESS, best=best))
            size = 1e-6 * sum(map(len, written.values()))
            candidates = {
                "write and fsync": plain_writes(root, written, best=best),
                "save": saves(root, learner, best=best),
            }
            title = f"Saving {kind}: {len(written)} files, {size:.1f} MB"
            measured = rates(candidates, ROUNDS)
            met.append(report(title, "saves", measured, "write and fsync", 1 / TARGET, "save"))
    finish(met)


if __name__ == "__main__":
    main()
