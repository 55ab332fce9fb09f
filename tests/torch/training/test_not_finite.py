"""Losses, gradients and parameters that are not finite are noticed before they do harm."""

from __future__ import annotations

import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, Transformation, View
from physx_core.components import PredictedBatch
from physx_core.errors import DivergedError
from physx_core.observers import read_scalars
from physx_core.pipelines import load_learner
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


class Parts(TorchNetwork):
    """Has parameters of one kind, small or large, and uses one row of the last."""

    def __init__(self, size=3, count=4, dtype=torch.float32, sparse=False):
        super().__init__()
        values = [torch.ones(size, 2, dtype=dtype) for _ in range(count)]
        self.parts = torch.nn.ParameterList(values)
        self.sparse = torch.nn.Embedding(size, 2, sparse=True) if sparse else None

    def forward(self, x):
        products = [(part * x[0, 0]).sum() for part in self.parts]
        if self.sparse is not None:
            products.append(self.sparse(torch.tensor([0, 1])).sum())
        return torch.stack(products).sum().reshape(1, 1)


def real_sum(prediction, target):
    """Has a gradient of 1 for each value."""
    return torch.view_as_real(prediction).sum() if prediction.is_complex() else prediction.sum()


KINDS = [{}, {"size": 5000}, {"dtype": torch.complex64}, {"dtype": torch.complex64, "size": 5000}]
KINDS += [{"sparse": True}, {"sparse": True, "size": 5000}, {"dtype": torch.float64, "size": 5000}]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("clip", [None, 0.5])
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_one_gradient_that_is_not_finite_is_named_in_its_step(kind, clip, bad):
    if clip and kind.get("sparse"):
        pytest.skip("PyTorch cannot clip sparse gradients")
    network = Parts(**kind)
    network.set_train()
    optimization = TorchOptimization(gradient_clip=clip)
    optimization.set_loss(real_sum)
    optimization.set_optimizer("SGD", network, lr=0.1, momentum=0.9)
    data = network.numpy_to_tensor({"input": np.ones((1, 1)), "ground_truth": np.ones((1, 1))})
    learn(network, optimization, data)

    def spoil(gradient):
        gradient = gradient.clone()
        (gradient._values() if gradient.is_sparse else gradient)[1, 0] = bad
        return gradient

    for name, parameter in network.named_parameters():
        before = content(network)
        with pytest.raises(DivergedError, match=f'gradient of the parameter "{re.escape(name)}"'):
            hook = parameter.register_hook(spoil)
            learn(network, optimization, data)
        hook.remove()
        assert is_equal(network, before)
        learn(network, optimization, data)  # nothing is left of it
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


@pytest.mark.parametrize("hidden", [8, 5000])
def test_gradients_so_large_that_only_their_norm_or_sum_overflows_are_fine(hidden):
    network = FC([2, hidden, 1])
    network.set_train()
    optimization = TorchOptimization()
    optimization.set_loss(lambda prediction, target: 1e36 * prediction.sum())
    optimization.set_optimizer("SGD", network, lr=1e-37)
    before = content(network)
    learn(network, optimization, samples(network))
    assert not is_equal(network, before) and network.find_not_finite() == ""


def test_a_step_that_the_scaler_of_float16_leaves_out_is_no_divergence():
    network, optimization = made(mixed_precision="float16")
    before, data = content(network), samples(network, scale=1e4)
    losses = [learn(network, optimization, data)]
    assert is_equal(network, before)  # its gradients overflowed
    losses += [learn(network, optimization, data) for _ in range(20)]
    assert not is_equal(network, before) and np.isfinite(losses).all()


@pytest.mark.slow
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
    return DatasetConfig(existing_dir="data", view=View(hold_back=False))


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


class Spoiled(Training):
    """Has a gradient that is NaN in the second batch of the second epoch."""

    def batch_begin(self):
        if (self.epoch_id, self.batch_id) == (1, 1):
            network = self.learner.network
            self.before = content(network)
            network.layers[0].bias.register_hook(lambda gradient: gradient * torch.nan)


@pytest.mark.parametrize("resumes", [False, True])
@pytest.mark.parametrize("options", [{}, {"gradient_clip": 0.1}, {"accumulate": 2}], ids=str)
@pytest.mark.parametrize("optimizer", ["Adam", "SGD"])
def test_the_network_before_the_first_gradient_that_is_nan_is_kept(
    data, optimizer, options, resumes
):
    network = dataclasses.replace(
        config(loss="MSELoss", optimization_kwargs=options),
        optimizer=optimizer,
        optimizer_kwargs={"lr": 0.05} | ({"momentum": 0.9} if optimizer == "SGD" else {}),
    )
    train = {"batch_size": 10, "seed": 3, "quiet": True}
    if resumes:
        Training(network, data, epoch_nb=1, **train).execute()
    spoiled = Spoiled(network, data, epoch_nb=3, resume=resumes, **train)
    with pytest.raises(DivergedError, match="Epoch 2, batch 2: the gradient of the par"):
        spoiled.execute()
    kept = load_learner("sessions/training").network
    assert is_equal(kept, spoiled.before)
    losses = read_scalars(Path("sessions/training"))["batch", "loss/batch"]
    assert list(losses) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("batch", [0, 1, 3])
def test_a_resumed_training_learns_from_the_batch_that_failed(data, batch):
    class Fails(Training):
        """Runs out of memory in a batch of the second epoch, once."""

        def optimize(self):
            if (self.epoch_id, self.batch_id, self.fails) == (1, batch, True):
                raise MemoryError("on purpose")
            super().optimize()

    train = {"batch_size": 10, "seed": 3, "quiet": True, "epoch_nb": 3}
    Fails.fails = False
    Fails(config(loss="MSELoss"), data, session_name="whole", **train).execute()
    Fails.fails = True
    with pytest.raises(MemoryError):
        Fails(config(loss="MSELoss"), data, **train).execute()
    Fails.fails = False
    Fails(config(loss="MSELoss"), data, resume=True, **train).execute()
    whole = content(load_learner("sessions/whole").network)
    assert is_equal(load_learner("sessions/training").network, whole)


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
