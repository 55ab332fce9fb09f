"""Losses, gradients and parameters that are not finite are noticed before they do harm."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, Transformation
from physx_core.components import PredictedBatch
from physx_core.errors import DivergedError
from physx_torch import FC, TorchNetwork, TorchOptimization


def made(loss="MSELoss", **options):
    network = FC([2, 8, 1])
    network.set_train()
    optimization = TorchOptimization(**options)
    optimization.set_loss(loss)
    optimization.set_optimizer("Adam", network, lr=0.1)
    return network, optimization


def samples(network, scale=1.0):
    x = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    return network.numpy_to_tensor({"input": x, "ground_truth": scale * x[:, :1]})


def learn(network, optimization, data):
    batch = PredictedBatch.of(network, Transformation(), data)
    loss = optimization.compute_loss(batch)
    optimization.optimize(loss)
    return optimization.transform_loss(loss, batch)["loss"]


def content(network):
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


def is_equal(network, before):
    return all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())


def root_of_zero(prediction, target):
    """Is 0, and its gradient is NaN."""
    return torch.sqrt((0 * (prediction - target)).square().sum())


def nan(prediction, target):
    """Is NaN."""
    return (prediction - target).sum() * float("nan")


@pytest.mark.parametrize("options", [{}, {"gradient_clip": 1.0}, {"accumulate": 2}])
def test_a_gradient_that_is_nan_is_named_and_changes_nothing(options):
    network, optimization = made(root_of_zero, **options)
    before, data = content(network), samples(network)
    with pytest.raises(DivergedError, match=r'gradient of the parameter "layers\.0\.weight"'):
        for _ in range(options.get("accumulate", 1)):
            learn(network, optimization, data)
    assert is_equal(network, before)
    optimization.set_loss("MSELoss")
    for _ in range(options.get("accumulate", 1)):  # nothing is left of it
        learn(network, optimization, data)
    assert not is_equal(network, before) and network.find_not_finite() == ""


@pytest.mark.parametrize("options", [{}, {"accumulate": 2}, {"mixed_precision": "float16"}])
def test_a_loss_that_is_nan_changes_nothing(options):
    network, optimization = made(nan, **options)
    before = content(network)
    with pytest.raises(DivergedError, match="the loss is nan"):
        learn(network, optimization, samples(network))
    assert is_equal(network, before)


def test_whoever_wants_to_continue_can():
    network, optimization = made(nan)
    optimization.stops_at_nan = False
    assert np.isnan(learn(network, optimization, samples(network)))
    assert network.find_not_finite() == "layers.0.weight"


def test_gradients_so_large_that_only_their_norm_overflows_are_fine():
    network, optimization = made(lambda prediction, target: 1e30 * (prediction - target).sum())
    optimization.set_optimizer("SGD", network, lr=1e-31)
    before = content(network)
    learn(network, optimization, samples(network))
    assert not is_equal(network, before)


def test_a_step_that_the_scaler_of_float16_leaves_out_is_no_divergence():
    network, optimization = made(mixed_precision="float16")
    before, data = content(network), samples(network, scale=1e4)
    losses = [learn(network, optimization, data)]
    assert is_equal(network, before)  # its gradients overflowed
    losses += [learn(network, optimization, data) for _ in range(20)]
    assert not is_equal(network, before) and np.isfinite(losses).all()


def test_gradients_that_no_scale_makes_finite_are():
    network, optimization = made(root_of_zero, mixed_precision="float16")
    for _ in range(60):
        learn(network, optimization, samples(network))
    with pytest.raises(DivergedError, match='mixed_precision="bfloat16"'):
        optimization.schedule(0.0)


def test_masks_may_hold_infinity_and_buffers_no_nan():
    class Masked(TorchNetwork):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(2, 1)
            self.register_buffer("mask", torch.full((2,), -torch.inf))

        def forward(self, x):
            return self.layer(x)

    network = Masked()
    assert network.find_not_finite() == ""
    network.mask[0] = torch.nan
    assert network.find_not_finite() == "mask"


class Told(TorchOptimization):
    """Records tensors that belong to a graph."""

    def transform_loss(self, loss, batch):
        return {"loss": loss, "twice": 2 * loss}


@pytest.fixture
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"input": x, "ground_truth": x[:, :1]})
    return DatasetConfig(existing_dir="data")


def config(**options):
    network = {"layers": [2, 8, 1], "opt_fields": "ground_truth"}
    return NetworkConfig("torch/fc", network_kwargs=network, optimizer="Adam", **options)


def test_tensors_that_a_loss_returns_become_numbers_without_a_warning(data):
    network = config(loss="MSELoss", optimization=Told)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        training = Training(network, data, epoch_nb=1, batch_size=10)
        training.execute()
    assert training.losses["twice"] == 2 * training.losses["loss"]
    assert all(type(value) is float for value in training.losses.values())


def test_a_training_says_where_the_gradient_became_nan(data):
    class Late(TorchOptimization):
        """Its gradient is NaN in the sixth batch, its loss never."""

        seen = 0

        def compute_loss(self, batch):
            self.seen += 1
            loss = super().compute_loss(batch)
            if self.seen != 6:
                return loss
            return loss + root_of_zero(*batch.prediction.values(), *batch.targets.values())

    network = config(loss="MSELoss", optimization=Late)
    place = "sessions/training/network/network_0"
    with pytest.raises(DivergedError, match="Epoch 2, batch 2: the gradient of the para") as caught:
        Training(network, data, epoch_nb=3, batch_size=10).execute()
    assert place in caught.value.__notes__[-1]
    with Dataset.open("data") as dataset:
        assert dataset.num_samples("training") == 40
