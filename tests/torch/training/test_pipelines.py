"""The interfaces within the pipelines: what users override is called, and nothing is taped."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from physx_core import (
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Prediction,
    Training,
    View,
)
from physx_core.errors import ConfigError, UsageError
from physx_core.pipelines import Learner
from physx_torch import FC, TorchNetwork, TorchOptimization, TorchTransformation


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((60, 3))
    with Dataset.create("data") as dataset:
        dataset.define_fields(
            "training",
            [Field("x", (3,)), Field("y", (1,)), Field("weight", (), role="additional")],
        )
        rows = {"x": x, "y": x[:, :1] * x[:, 1:2], "weight": 1 + (x[:, 0] > 0)}
        dataset.append("training", rows)
    return DatasetConfig(existing_dir="data", normalize=True)


def config(**options):
    return NetworkConfig(
        **{
            "network": "torch/fc",
            "network_kwargs": {"layers": [3, 8, 1], "net_fields": "x", "opt_fields": "y"},
            "loss": "MSELoss",
            "optimizer": "Adam",
            "device": "cpu",
            **options,
        }
    )


class Weighted(TorchOptimization):
    """Weighs samples by a field of the batch, and records more than the loss."""

    extra_fields = ("weight",)

    def compute_loss(self, batch):
        self.error = (batch.prediction["y"] - batch.targets["y"])[:, 0] ** 2
        return (batch.data["weight"] * self.error).mean()

    def transform_loss(self, loss, batch):
        worst, weight = self.error.detach().max(), batch.data["weight"].mean()
        return {"loss": loss.item(), "worst": worst.item(), "weight": weight.item()}


def test_extra_entries_of_the_loss_are_recorded(data):
    network = config(optimization=Weighted, loss=None, require_training_stuff=False)
    with pytest.raises(UsageError, match="set_optimizer"):  # no optimizer was asked for
        Training(
            config(optimization=Weighted, optimizer=None, require_training_stuff=False),
            data, epoch_nb=1, batch_size=20,
        ).execute()  # fmt: skip
    training = Training(network, data, epoch_nb=2, batch_size=20, seed=0, session_name="run")
    training.execute()
    assert set(training.losses) == {"loss", "worst", "weight"}
    with Path("sessions/run/stats/scalars.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["name"] == "worst/batch"]
    assert len(rows) == 6
    assert float(rows[-1]["value"]) == training.losses["worst"]
    assert 1 <= training.losses["weight"] <= 2


class Watching(TorchTransformation):
    """Notes whether what passes needs gradients."""

    def __init__(self):
        super().__init__()
        self.taped = {}

    def transform_before_prediction(self, data):
        self.taped["inputs"] = any(t.requires_grad for t in data.values())
        return super().transform_before_prediction(data)

    def transform_before_loss(self, prediction, targets):
        prediction, targets = super().transform_before_loss(prediction, targets)
        self.taped["trained"] = all(t.requires_grad for t in prediction.values())
        self.taped["targets"] = any(t.requires_grad for t in targets.values())
        return prediction, targets

    def transform_before_apply(self, prediction):
        prediction = super().transform_before_apply(prediction)
        self.taped["applied"] = any(t.requires_grad for t in prediction.values())
        return prediction


def test_only_what_is_learned_from_has_a_tape(data):
    data = dataclasses.replace(data, view=View(fold=0))
    options = {"epoch_nb": 1, "batch_size": 20, "validation_every": 0, "seed": 0, "rivals": "none"}
    training = Training(config(transformation=Watching), data, **options)
    with training:
        training.execute()
        check_tapes(training)


def check_tapes(training):
    taped = training.learner.transformation.taped
    assert taped == {"inputs": False, "trained": True, "targets": False}
    training.learner.predict_in_training({"x": np.zeros((1, 3))})
    assert taped["applied"] is False
    training.validate()
    assert taped["trained"] is False  # the validation, last


class Doubling(TorchNetwork):
    """Decides itself which fields go where."""

    net_fields = ("x",)
    opt_fields = ("y",)

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 1)

    def predict(self, data):
        return {"y": 2 * self(data["x"])}

    def forward(self, x):
        return self.layer(x)


def test_a_network_may_override_predict(data):
    network = config(network=Doubling, network_kwargs={})
    network_options = {"optimization_kwargs": {"mixed_precision": "bfloat16"}}
    mixed = config(network=Doubling, network_kwargs={}, **network_options)
    losses = []
    for chosen in (network, mixed):
        training = Training(chosen, data, epoch_nb=1, batch_size=20, seed=0)
        training.execute()
        losses.append(training.training_loss)
    assert losses[0] == pytest.approx(losses[1], rel=0.05) and losses[0] != losses[1]


def test_forward_is_what_a_network_must_have():
    class Nothing(TorchNetwork):
        pass

    with pytest.raises(UsageError, match=r"Nothing does not implement forward\(\)"):
        Nothing().predict({"input": torch.zeros(1, 1)})
    assert torch.equal(*(net(torch.ones(1, 2)) for net in [FC([2, 1])] * 2))


class Cloud(Environment):
    def create(self):
        self.given = []

    def init_database(self):
        self.define_training_fields([Field("x", (3,)), Field("y", (1,))])

    def step(self):
        x = self.rng.standard_normal(3)
        asked = self.get_prediction(x=x)["y"]
        assert isinstance(asked, np.ndarray) and asked.shape == (1,)
        self.set_training_data(x=x, y=x[:1])
        self.given.append(asked)

    def apply_prediction(self, prediction):
        np.testing.assert_allclose(prediction["y"], self.given[-1], rtol=1e-6)


def test_prediction_in_an_environment(data):
    Training(config(), data, epoch_nb=1, batch_size=20, seed=0, session_name="run").execute()
    environment = EnvironmentConfig(Cloud, as_tcp_ip_client=False)
    Prediction(NetworkConfig(), environment, session_name="run", step_nb=5).execute()


def test_scheduler_of_the_configuration(data):
    network = config(
        lr=1.0, optimizer="SGD", scheduler="StepLR", scheduler_kwargs={"step_size": 1, "gamma": 0.1}
    )
    training = Training(network, data, epoch_nb=3, batch_size=60, seed=0)
    training.execute()
    assert training.learner.optimization.learning_rate() == pytest.approx(1e-3)
    with pytest.raises(ConfigError, match="without a scheduler"):
        Learner(config(scheduler_kwargs={"step_size": 1}), trains=True)
    with pytest.raises(ConfigError, match="LeastSquares has no schedulers"):
        Learner(NetworkConfig("toy/linear", scheduler="StepLR"), trains=True)
