"""Validation, early stopping, the best checkpoint, and what is recorded of an epoch."""

import csv
import math
import statistics
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Observer,
    Prediction,
    Training,
    View,
)
from physx_core.checkpoint import read
from physx_core.components import Group
from physx_core.errors import CheckpointError, ConfigError, UnknownOptionError
from physx_core.toy import LeastSquares, Linear

DATA = DatasetConfig(existing_dir="data", view=View(hold_back=False))


class Scripted(LeastSquares):
    """Reports losses that were given, one for each epoch, and a learning rate."""

    def __init__(self, losses, validation=None):
        self.losses, self.epoch, self.judged = losses, 0, []
        self.validation = validation or losses

    def transform_loss(self, loss, batch):
        now = self.losses if len(batch.data["state"]) == 5 else self.validation
        return {"loss": now[self.epoch], "rows": len(batch.data["state"])}

    def learning_rate(self):
        return 0.5**self.epoch

    def epoch_end(self, loss):
        self.judged.append(loss)
        self.epoch += 1


@pytest.fixture
def data():
    """Ten samples to learn from."""
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        dataset.append("training", fields(rng, 10))
    return rng


@pytest.fixture
def validated(data):
    """Six samples to validate with, beside those of `data`."""
    with Dataset.open("data", writable=True, session="data") as dataset:
        dataset.append("validation", fields(data, 6))


def fields(rng, rows):
    return {"state": rng.random((rows, 2)), "next_state": rng.random((rows, 2))}


def training(losses, validation=None, *, network=None, **options):
    config = NetworkConfig(
        Linear,
        optimization=Scripted,
        optimization_kwargs={"losses": losses, "validation": validation},
        **(network or {}),
    )
    options = {"epoch_nb": len(losses), "batch_size": 5, "seed": 0, **options}
    options.setdefault("validation_batch_size", 6)
    return Training(config, DATA, **options)


def recorded(session="training"):
    """Return the numbers of a session as {name: [values]}."""
    found = {}
    with Path(f"sessions/{session}/stats/scalars.csv").open() as stream:
        for row in csv.DictReader(stream):
            found.setdefault(row["name"], []).append(float(row["value"]))
    return found


def checkpoints(session="training"):
    return sorted(p.name for p in Path(f"sessions/{session}/network").iterdir())


# What is recorded -------------------------------------------------------------------------------


def test_all_entries_of_the_loss_are_recorded_by_batch_epoch_and_validation(validated):
    training([3.0, 2.0], [5.0, 4.0]).execute()
    found = recorded()
    assert found["loss/batch"] == [3, 3, 2, 2]
    assert found["loss/training"] == [3, 2] and found["loss/validation"] == [5, 4]
    assert found["rows/batch"] == [5] * 4 and found["rows/training"] == [5, 5]
    assert found["rows/validation"] == [6, 6]
    assert found["learning_rate"] == [1, 0.5]


def test_the_variance_is_that_of_the_last_fifty_batches_and_epochs(data):
    rng = np.random.default_rng(1)

    class Random(Scripted):
        def transform_loss(self, loss, batch):
            return {"loss": float(rng.random())}

    config = NetworkConfig(Linear, optimization=Random, optimization_kwargs={"losses": []})
    Training(config, DATA, epoch_nb=35, batch_size=5, seed=0).execute()
    found = recorded()
    losses = found["loss/batch"]
    assert len(losses) == 70 and found["loss/variance"][0] == 0
    for count in (2, 7, 50, 51, 70):
        window = losses[max(0, count - 50) : count]
        assert math.isclose(found["loss/mean"][count - 1], statistics.fmean(window))
        assert math.isclose(found["loss/variance"][count - 1], statistics.variance(window))
    epochs = found["loss/training"]
    assert len(epochs) == 35 and found["loss/training_variance"][0] == 0
    for count in (2, 35):
        assert math.isclose(found["loss/training_mean"][count - 1], np.mean(epochs[:count]))
        variance = statistics.variance(epochs[:count])
        assert math.isclose(found["loss/training_variance"][count - 1], variance)


def test_the_numbers_do_not_depend_on_when_they_are_reported(data, monkeypatch):
    written = []
    for seconds in (-1.0, 0.0003, 1e9):  # after each batch, some batches, each epoch
        monkeypatch.setattr("physx_core.pipelines.training.REPORT_SECONDS", seconds)
        config = NetworkConfig(Linear, optimization=LeastSquares)
        pipeline = Training(config, DATA, epoch_nb=30, batch_size=3, seed=0)
        pipeline.execute()
        written.append((pipeline.session.path / "stats" / "scalars.csv").read_text())
    assert written[0].count("loss/batch") == 120
    assert written == [written[0]] * 3


def test_observers_without_a_method_of_their_own_are_not_called(data):
    told = []

    class Silent(Observer):
        def __getattribute__(self, name):
            told.append(name)
            return super().__getattribute__(name)

    training([1.0], statistics=[Silent], batch_nb=50).execute()
    assert told.count("scalars") == told.count("advance") == 1  # looked up once


def test_validation_every_k_epochs(validated):
    pipeline = training([4.0, 3.0, 2.0, 1.0, 0.5], validation_every=2)
    with pipeline:
        pipeline.execute()
        judged = pipeline.learner.optimization.judged
    assert recorded()["loss/validation"] == [3, 1]
    assert pipeline.validation_loss == 1
    assert [math.isnan(loss) for loss in judged] == [True, False, True, False, True]


def test_without_validation_epochs_are_judged_by_their_training_loss(data):
    pipeline = training([2.0, 1.0])
    with pipeline:
        pipeline.execute()
        assert pipeline.learner.optimization.judged == [2, 1]


class Measured(Linear):
    """Notes how many rows it predicts at once, and whether it learns from them."""

    def __init__(self, **options):
        super().__init__(**options)
        self.trains, self.sizes = False, {True: set(), False: set()}

    def set_train(self):
        self.trains = True

    def set_eval(self):
        self.trains = False

    def predict(self, data):
        self.sizes[self.trains].add(len(data["state"]))
        return super().predict(data)


@pytest.fixture
def many():
    """200 samples to learn from, and 3001 to validate with."""
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        dataset.append("training", fields(rng, 200))
        dataset.append("validation", fields(rng, 3001))


def measured(**options):
    """Train for two epochs; return the numbers of rows at once, and the validation losses."""
    network = NetworkConfig(Measured, data_type="float64")
    pipeline = Training(network, DATA, epoch_nb=2, batch_size=20, seed=0, **options)
    with pipeline:
        pipeline.execute()
        sizes = pipeline.learner.network.sizes
    return sizes[False], recorded(pipeline.session.path.name)["loss/validation"]


@pytest.mark.slow
@pytest.mark.reported(
    "keras#6217",
    "unsloth#1147",
    "mmsegmentation#1432",
    "OpenNMT-py#1089",
    about="validation runs out of memory where training does not",
)
def test_a_validation_takes_as_many_rows_at_once_as_the_training(many):
    sizes, losses = measured()
    assert sizes == {20, 1}
    alone, expected = measured(validation_batch_size=3001)
    assert alone == {3001}
    assert losses == pytest.approx(expected, rel=1e-12)
    assert measured(validation_batch_size=64)[0] == {64, 3001 % 64}
    with pytest.raises(ConfigError, match="validation_batch_size"):
        measured(validation_batch_size=0)


def test_held_back_samples_are_taken_in_batches_of_the_same_size():
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        dataset.append("training", fields(rng, 3000))
    config = DatasetConfig(existing_dir="data", view=View(folds=2, fold=0))
    pipeline = Training(NetworkConfig(Measured), config, epoch_nb=1, batch_size=7, seed=0)
    with pipeline:
        pipeline.execute()
        assert pipeline.learner.network.sizes[False] == {7, (93 * 16 + 8) % 7}


class Shown(Observer):
    """Keeps the truth that predictions are compared with."""

    truth: ClassVar = []

    def predictions(self, predicted, truth, step, timeline):
        assert {n: v.shape for n, v in predicted.items()} == {n: v.shape for n, v in truth.items()}
        self.truth.append(truth["next_state"])


def test_predictions_to_be_shown_are_made_in_batches_too(many):
    with Dataset.open("data") as dataset:
        chosen = np.linspace(0, 3000, 64).astype(int)
        expected = dataset["validation"]["next_state"][chosen]
    sizes, _ = measured(statistics=[Shown], validation_batch_size=10)
    assert sizes == {10, 1, 4}
    for truth in Shown.truth:  # of the whole validation set, the same in each epoch
        np.testing.assert_array_equal(truth, expected)


def test_histograms_of_weights_come_every_k_epochs(data):
    seen = []

    class Sees(Observer):
        def histograms(self, values, step, timeline):
            seen.append((step, timeline, {name: value.shape for name, value in values.items()}))

    training([1.0] * 4, statistics=[Sees], histograms_every=2).execute()
    assert seen == [(2, "epoch", {"weights/weights": (3, 2)}), (4, "epoch", seen[0][2])]


def test_statistics_go_where_they_were_sent_with_their_arguments(data):
    made = []

    class Sees(Observer):
        def __init__(self, size=0):
            self.size, self.names = size, set()
            made.append(self)

        def scalars(self, values, step, timeline):
            self.names |= values.keys()

    training([1.0], statistics=[Sees], statistics_kwargs={str(Sees): {"size": 3}}).execute()
    assert made[0].size == 3 and {"loss/batch", "loss/training"} <= made[0].names
    with pytest.raises(UnknownOptionError, match="rerum"):
        training([1.0], statistics="rerun", statistics_kwargs={"rerum": {}}).execute()


# Early stopping ---------------------------------------------------------------------------------


def test_a_training_stops_when_nothing_improves_and_says_why(validated, capfd):
    pipeline = training([9.0] * 8, [5, 4, 3, 3.5, 3, 3, 1, 1], patience=3)
    pipeline.execute()
    assert pipeline.epoch_id == 6
    assert "did not improve 3 times in a row" in pipeline.stopped
    assert "smallest validation loss 3, after epoch 3" in pipeline.stopped
    assert pipeline.stopped in Path("sessions/training/info.txt").read_text()
    assert pipeline.stopped in capfd.readouterr().err


def test_small_improvements_do_not_count_but_add_up(data):
    losses = [1.0, 0.96, 0.92, 0.88, 0.84, 0.80]
    assert finished_epochs(losses, patience=1, min_improvement=0.05) == 2
    assert finished_epochs(losses, patience=2, min_improvement=0.05) == 6


def finished_epochs(losses, **options):
    pipeline = training(losses, **options)
    pipeline.execute()
    return pipeline.epoch_id


def test_patience_counts_validations(validated):
    assert finished_epochs([1.0] * 9, patience=2, validation_every=2) == 6


def test_nan_loss_is_no_improvement(data):
    assert finished_epochs([math.nan] * 9, patience=2, on_nan="continue") == 2


def test_a_training_that_reaches_its_last_epoch_did_not_stop(data):
    pipeline = training([1.0] * 3, patience=2)
    pipeline.execute()
    assert pipeline.epoch_id == 3 and pipeline.stopped == ""


def test_a_stopped_training_writes_no_checkpoint_twice(data):
    training([1.0] * 9, patience=2, network={"save_each_epoch": True}).execute()
    assert checkpoints() == ["network_0", "network_1", "network_2", "network_best"]


# The best checkpoint ----------------------------------------------------------------------------


def test_best_checkpoint_has_smallest_validation_loss(validated):
    pipeline = training([9.0, 8, 7, 6], [4, 2, 3, 5], network={"save_each_epoch": True})
    pipeline.execute()
    assert (pipeline.best.loss, pipeline.best.epoch) == (2, 2)
    network = Path("sessions/training/network")
    assert read(network / "network_best").progress.epoch == 2
    names = ["network_1", "network_2", "network_best"]
    second, third, best = ((network / n / "parameters.npz").read_bytes() for n in names)
    assert best == second != third


def test_the_best_network_can_be_chosen_and_leaves_the_numbers_alone(data):
    training([1.0, 0.5], network={"save_best": True}).execute()
    assert checkpoints() == ["network_0", "network_best"]
    best = {"network_dir": "sessions/training", "which_network": "best"}
    training([1.0], network=best, session_name="from_best").execute()
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    config = NetworkConfig(which_network="best")
    Prediction(config, spring, session_name="training", step_nb=2).execute()
    training([1.0], new_session=False).execute()
    assert checkpoints() == ["network_0", "network_1", "network_best"]


def test_a_missing_best_network_is_named(data):
    training([1.0]).execute()
    training([1.0], network={"save_best": False}, patience=1, session_name="other").execute()
    assert checkpoints() == checkpoints("other") == ["network_0"]
    best = {"network_dir": "sessions/training", "which_network": "best"}
    with pytest.raises(CheckpointError, match='"network_best".*Available: network_0'):
        training([1.0], network=best).execute()
    with pytest.raises(ConfigError, match="which_network"):
        NetworkConfig(which_network="worst")


# Several processes ------------------------------------------------------------------------------


def test_a_share_of_each_batch(monkeypatch):
    batch = {"x": np.arange(7), "y": np.arange(14).reshape(7, 2)}
    group = Group()
    group.size, seen, weights = 3, [], 0
    for rank in range(3):
        group.rank = rank
        share, weight = group.share_of(batch)
        assert np.array_equal(share["y"], batch["y"][share["x"]])
        seen += share["x"].tolist()
        weights += weight
    assert seen == list(range(7)) and math.isclose(weights, 1)
    group.rank = 0
    share, weight = group.share_of({"x": np.arange(2)})
    assert (len(share["x"]), weight) == (1, 0)


def test_what_cannot_be_trained_by_several_processes(data, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match="Linear cannot be trained by several processes"):
        training([1.0]).execute()

    class Pair(Group):
        size = 2

    class Joins(Linear):
        @classmethod
        def join_group(cls, device):
            return Pair()

    options = {"epoch_nb": 1, "batch_nb": 1, "batch_size": 2}
    for data, choice, advice in (
        (DATA, {"load_samples": True}, "send the stored samples through them in one process"),
        (DATA, {"load_samples": True, "only_first_epoch": False}, "or train in one process"),
    ):
        spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, **choice)
        with pytest.raises(ConfigError, match=f"cannot replay samples for several.*{advice}"):
            Training(NetworkConfig(Joins), data, spring, **options).execute()
    with pytest.raises(ConfigError, match="LeastSquares cannot work in several processes"):
        Training(NetworkConfig(Joins), DATA, **options).execute()
    assert not Path("sessions/training").exists()
