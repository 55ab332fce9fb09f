"""The order of a training's stored samples: kept by a resumed training, whatever memory is free."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, checkpoint
from physx_core.dataset.read.strategies import prefetch, strategy

PLENTY, LITTLE = 10**12, 10


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Dataset.create("data") as dataset:
        x = np.arange(2000.0)
        dataset.append("training", {"x": x[:, None], "y": 2 * x[:, None], "unused": x})


@pytest.fixture
def free(monkeypatch):
    """Return a function that sets the number of free bytes."""

    def set_free(nbytes):
        for module in (strategy, prefetch):
            monkeypatch.setattr(module, "memory_budget", lambda: nbytes)

    return set_free


class Followed(Training):
    """Notes the samples of each batch, and calls a function before each epoch."""

    def epoch_begin(self):
        self.before(self.epoch_id)
        super().epoch_begin()

    def optimize(self):
        self.rows.extend(self.batch["x"].ravel().tolist())
        super().optimize()


def train(epoch_nb, name="run", before=lambda epoch: None, existing="data", **options):
    network = NetworkConfig("toy/linear", {"net_fields": ["x"], "opt_fields": ["y"]})
    training = Followed(
        network, DatasetConfig(existing_dir=existing, **options.pop("config", {})),
        epoch_nb=epoch_nb, batch_size=300, seed=0, session_name=name, **options,
    )  # fmt: skip
    training.before, training.rows = before, []
    training.execute()
    return training


@pytest.mark.parametrize("config", [{}, {"validation_split": 0.2}])
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


def test_the_order_is_in_the_checkpoint_and_another_speed_is_told(free, capsys):
    free(PLENTY)
    training = train(1)
    found = checkpoint.read(training.checkpoint_path).progress.order
    assert found["strategy"] == "memory"
    free(LITTLE)
    capsys.readouterr()
    resumed = train(2, resume=True)
    said = "by the strategy 'disk exact' instead of 'memory'"
    assert said in capsys.readouterr().err
    assert said in (resumed.session.path / "info.txt").read_text()


def test_blocks_keep_their_size_although_other_fields_are_read(free):
    free(LITTLE)
    training = train(1)
    order = checkpoint.read(training.checkpoint_path).progress.order
    assert order["strategy"] == "disk windowed"
    with Dataset.open("data") as dataset:
        for block in (7, order["block"]):
            read = [
                [*dataset.batches("training", 300, shuffle=True, seed=0, fields=fields,
                                  strategy="disk windowed", block=block)]
                for fields in (["x"], ["x", "y", "unused"])
            ]  # fmt: skip
            for one, other in zip(*read, strict=True):
                np.testing.assert_array_equal(one["x"], other["x"])


def test_rows_in_the_order_of_writing_need_no_record(free):
    free(LITTLE)
    training = train(1, config={"shuffle": False})
    assert checkpoint.read(training.checkpoint_path).progress.order == {}
    assert training.rows == [*range(2000)]
