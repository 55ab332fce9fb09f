"""A training on a view, to be killed and resumed while samples are added to its data.

Arguments: name of the session, name of the view. A session "killed" has samples added as soon as it
has a checkpoint, which fixes the samples that it learns from.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import numpy as np

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, View

WINDOW = {"past": ("x", [-1, 0]), "next": ("x", 1)}
VIEWS = {
    "folds": View(window=WINDOW, fold=3),
    "test_fold": View(window=WINDOW, fold=0, test_fold=4),
    "mixture": View(window=WINDOW, sources={"a": 0.7, "b": 0.3}),
    "weights": View(window=WINDOW, weights="class:label"),
}


def store(folder: str, count: int) -> None:
    """Add trajectories of 10 rows of one instance."""
    is_new = not Path(folder, "dataset.json").exists()
    with Dataset.create(folder) if is_new else Dataset.open(folder, writable=True) as dataset:
        first = 0 if is_new else dataset.num_samples("training")
        number = np.arange(first, first + 10 * count)
        x = np.sin(0.1 * number)[:, None]
        rows = {"x": x, "label": number // 10 % 3, "step": number % 10}
        known = {"episode": number // 10, "env_id": np.ones(len(number), int)}
        dataset.append("training", rows | known)


class Slow(Training):
    """Takes its time for each batch, and has samples added meanwhile."""

    grows = False
    adding: threading.Thread | None = None

    def batch_end(self) -> None:
        time.sleep(0.004)
        if self.grows and self.adding is None and self.session.network_dir.exists():
            self.adding = threading.Thread(target=self.add)
            self.adding.start()

    def train_end(self) -> None:
        if self.adding is not None:
            self.adding.join()

    def add(self) -> None:
        for _ in range(3):
            store("a", 2)
            time.sleep(0.05)


def training(name: str, view: str) -> Slow:
    """Return a training that goes on if it was begun before."""
    network = NetworkConfig("toy/linear", {"net_fields": "past", "opt_fields": "next"})
    chosen = VIEWS[view]
    return Slow(
        network, DatasetConfig(existing_dir=None if chosen.sources else "a", view=chosen,
                               normalize=True),
        session_name=name, new_session=False, resume=Path("sessions", name).exists(), epoch_nb=3,
        batch_size=16, seed=0, checkpoint_every=4, quiet=True,
    )  # fmt: skip


if __name__ == "__main__":
    made = training(*sys.argv[1:])
    made.grows = sys.argv[1] == "killed"
    made.execute()
