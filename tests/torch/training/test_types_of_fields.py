"""Fields that are no real floating-point numbers: converted by one rule, or named in an error."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.errors import FieldsMismatchError, FieldTypeError
from physx_torch import FC, TorchOptimization


def train(x, y, network="torch/fc", kwargs=None, **options):
    kwargs = {"layers": [x[0].size, y[0].size]} if kwargs is None else kwargs
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x, "y": y})
    config = NetworkConfig(
        network,
        {"net_fields": "x", "opt_fields": "y", **kwargs},
        loss=options.pop("loss", "MSELoss"),
        optimizer="SGD",
        lr=1e-4,
        device="cpu",
    )
    data = DatasetConfig(existing_dir="data")
    training = Training(config, data, epoch_nb=2, batch_size=5, seed=0, quiet=True, **options)
    training.execute()
    return training


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


TYPES = ["?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", np.longdouble]
REAL = np.random.default_rng(0).integers(0, 2, (20, 3))


@pytest.mark.parametrize("kind", TYPES)
def test_networks_of_physx_compute_with_every_type_as_real_numbers(kind):
    expected = train(REAL.astype("f4"), REAL[:, :1].astype("f4")).training_loss
    shutil.rmtree("data")
    training = train(REAL.astype(kind), REAL[:, :1].astype(kind))
    assert training.training_loss == pytest.approx(expected, rel=1e-6)
    batch = {"x": REAL.astype(kind)}
    assert training.learner.predict(batch)["y"].dtype == np.float32


class Linear(torch.nn.Module):
    """A layer of a type."""

    def __init__(self, kind="float32"):
        super().__init__()
        self.layer = torch.nn.Linear(3, 1, dtype=getattr(torch, kind))

    def forward(self, x):
        return self.layer(x)


@pytest.mark.parametrize("kind", ["?", "u1", "i8", "c16"])
def test_other_modules_get_an_error_that_names_the_field(kind):
    with pytest.raises(FieldTypeError, match='does not accept the types .*"x"') as caught:
        train(REAL.astype(kind), REAL[:, :1].astype("f8"), Linear, {"kind": "float32"})
    assert caught.value.field == "x"


class Square(torch.nn.Module):
    """The mean square of complex or real errors."""

    def forward(self, prediction, target):
        return (prediction - target).abs().square().mean()


@pytest.mark.parametrize("kind", ["c8", "c16", np.clongdouble])
def test_complex_numbers_get_the_precision_of_the_network(kind):
    x = (REAL + 1j * REAL[::-1]).astype(kind)
    training = train(x, x[:, :1], Linear, {"kind": "complex64"}, loss=Square)
    assert training.learner.predict({"x": x})["y"].dtype == np.complex64
    network = FC([1, 1])
    network.set_data_type("float64")
    assert network.numpy_to_tensor({"x": x})["x"].dtype == torch.complex128


def test_networks_of_real_numbers_refuse_complex_fields_by_name():
    x = REAL + 1j
    with pytest.raises(FieldsMismatchError, match="real numbers") as caught:
        train(x, REAL[:, :1].astype("f8"))
    assert "x: complex" in str(caught.value)


class Embedded(torch.nn.Module):
    """Takes indices."""

    def __init__(self):
        super().__init__()
        self.table = torch.nn.Embedding(2, 4)

    def forward(self, x):
        return self.table(x).mean((1, 2))[:, None]


@pytest.mark.parametrize("kind", ["i2", "u1", "u4", "i8"])
def test_indices_of_every_integer_type_reach_embeddings(kind):
    train(REAL.astype(kind), REAL[:, :1].astype("f4"), Embedded, {})


class Masked(torch.nn.Module):
    """Takes a mask."""

    def __init__(self):
        super().__init__()
        self.value = torch.nn.Parameter(torch.ones(()))

    def forward(self, x):
        return self.value * (~x).sum(1, keepdim=True)


def test_masks_reach_modules_as_masks():
    train(REAL.astype(bool), REAL[:, :1].astype("f4"), Masked, {})


@pytest.mark.parametrize("kind", ["?", "i2", "u1", "u8", "i8"])
def test_class_labels_may_have_every_type(kind):
    x, labels = REAL.astype("f4"), REAL[:, 0].astype(kind)
    module = {"in_features": 3, "out_features": 2}
    training = train(x, labels, "torch.nn:Linear", module, loss="CrossEntropyLoss")
    assert training.training_loss == pytest.approx(0.7, abs=0.3)


def test_integers_too_large_for_torch_are_named():
    network = FC([1, 1])
    with pytest.raises(FieldTypeError, match=f'"x" contains {2**63}'):
        network.numpy_to_tensor({"x": np.array([[2**63]], np.uint64)})


# Sums ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_recorded_losses_do_not_depend_on_the_sizes_of_batches(reduction):
    x = np.random.default_rng(0).standard_normal((20, 3))
    with Dataset.create("data") as dataset:
        for mode in ("training", "validation"):
            dataset.append(mode, {"x": x, "y": x[:, :1]})
    losses = []
    for size in (20, 4):
        training = Training(
            NetworkConfig(
                "torch/fc", {"layers": [3, 1], "net_fields": "x", "opt_fields": "y"},
                loss="MSELoss", optimizer="SGD", lr=1e-12, device="cpu",
                optimization_kwargs={"loss_kwargs": {"reduction": reduction}},
            ),
            DatasetConfig(existing_dir="data"), epoch_nb=1, batch_size=size,
            validation_batch_size=7, seed=0, quiet=True,
        )  # fmt: skip
        training.execute()
        losses += [training.training_loss, training.validation_loss]
    assert losses == pytest.approx([losses[0]] * 4, rel=1e-5)


def test_gradients_are_those_of_the_sum():
    x, steps = REAL.astype("f4"), []
    for reduction, lr in (("sum", 1e-3), ("mean", 2e-2)):
        torch.manual_seed(0)
        network = FC([3, 1])
        optimization = TorchOptimization(loss_kwargs={"reduction": reduction})
        optimization.set_loss("MSELoss")
        optimization.set_optimizer("SGD", network, lr=lr)
        loss = optimization.loss(network(torch.from_numpy(x)), torch.from_numpy(x[:, :1]))
        optimization.optimize(loss)
        steps.append(network.layers[0].weight.detach().clone())
    torch.testing.assert_close(*steps)
