"""The order of a training's stored samples: the same whatever memory is free, and when resumed."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import Batches, Dataset, DatasetConfig, NetworkConfig, Training, View
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import memory

PLENTY, LITTLE = 10**12, 10


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Dataset.create("data") as dataset:
        x = np.arange(2000.0)
        dataset.append("training", {"x": x[:, None], "y": 2 * x[:, None], "unused": x[:, None]})


@pytest.fixture
def free(monkeypatch):
    """Return a function that sets the number of free bytes."""

    return lambda nbytes: monkeypatch.setattr(memory, "available_memory", lambda: nbytes)


class Followed(Training):
    """Notes the samples of each batch, and calls a function before each epoch."""

    def epoch_begin(self):
        self.before(self.epoch_id)
        super().epoch_begin()

    def optimize(self):
        self.rows.extend(self.batch["x"].ravel().tolist())
        super().optimize()


def train(epoch_nb, name="run", before=lambda epoch: None, existing="data", **options):
    fields = options.pop("fields", ["x"])
    network = NetworkConfig("toy/linear", {"net_fields": fields, "opt_fields": ["y"]})
    config = {"view": View(hold_back=False), **options.pop("config", {})}
    training = Followed(
        network, DatasetConfig(existing_dir=existing, **config),
        epoch_nb=epoch_nb, batch_size=300, seed=0, session_name=name, **options,
    )  # fmt: skip
    training.before, training.rows = before, []
    training.execute()
    return training


@pytest.mark.parametrize("config", [{}, {"view": View(fold=0)}])
@pytest.mark.parametrize(("first", "then"), [(PLENTY, LITTLE), (LITTLE, PLENTY)])
def test_resume_keeps_reading_order_at_any_free_memory(free, first, then, config):
    free(first)
    whole = train(3, "whole", config=config)
    train(1, config=config)
    free(then)
    resumed = train(2, resume=True, config=config)
    again = train(3, resume=True, config=config)
    assert resumed.rows + again.rows == whole.rows[len(whole.rows) // 3 :]


def test_the_order_stays_if_memory_becomes_free_or_scarce_between_epochs(free):
    free(LITTLE)
    whole = train(3, "whole")
    changing = train(3, before=lambda epoch: free(PLENTY if epoch else LITTLE))
    assert changing.rows == whole.rows


def test_a_resumed_training_reads_no_batch_again(free, monkeypatch):
    monkeypatch.setattr(shuffling, "_MOST_SORTED", 100)
    free(LITTLE)
    train(2)
    read = []
    get = Batches.__getitem__
    monkeypatch.setattr(
        Batches, "__getitem__", lambda self, number: read.append(number) or get(self, number)
    )
    assert len(train(3, resume=True).rows) == 2000
    assert read == [*range(14, 21)]


def test_other_inputs_change_no_batch(free, monkeypatch):
    monkeypatch.setattr(shuffling, "_MOST_SORTED", 100)
    free(LITTLE)
    fewer = train(2)
    more = train(2, "more", fields=["x", "unused"])
    assert fewer.rows == more.rows


def test_rows_in_the_order_of_writing(free):
    free(LITTLE)
    assert train(1, config={"shuffle": False}).rows == [*range(2000)]
