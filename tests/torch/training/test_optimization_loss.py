"""How a loss is chosen and computed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Transformation
from physx_core.components import PredictedBatch
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch import FC, TorchOptimization


def optimization_of(network, loss="MSELoss", **options):
    optimization = TorchOptimization(**options)
    optimization.set_loss(loss)
    optimization.set_optimizer("Adam", network)
    return optimization


def batch_of(prediction, targets):
    """Return a batch as an optimization gets it; nothing is normalized."""
    return PredictedBatch(
        None, Transformation(), data=targets, inputs={}, output=prediction,
        prediction=prediction, targets=targets,
    )  # fmt: skip


# Values -----------------------------------------------------------------------------------------


def test_several_fields_have_the_mean_of_their_losses():
    network = FC([2, 4], opt_fields=["a", "b"], pred_fields=["pa", "pb"])
    optimization = optimization_of(network, "L1Loss")
    prediction = {"pb": torch.zeros(5, 3), "pa": torch.zeros(5, 1)}
    targets = {"a": torch.full((5, 1), 4.0), "b": torch.full((5, 3), 2.0)}
    assert optimization.compute_loss(batch_of(prediction, targets)).item() == 3.0


def test_shapes_that_would_be_broadcast_are_an_error():
    optimization = optimization_of(FC([2, 1]))
    with pytest.raises(FieldsMismatchError, match=r"\(4, 1\).*\(4,\)") as caught:
        optimization.compute_loss(
            batch_of({"prediction": torch.zeros(4, 1)}, {"ground_truth": torch.zeros(4)})
        )
    assert set(caught.value.differences) == {"prediction"}


def test_class_indices_as_targets():
    options = {"loss_kwargs": {"label_smoothing": 0.0}}
    optimization = optimization_of(FC([2, 3]), "CrossEntropyLoss", **options)
    target = torch.tensor([0, 2])
    loss = optimization.compute_loss(
        batch_of({"prediction": torch.zeros(2, 3)}, {"ground_truth": target})
    )
    assert loss.item() == pytest.approx(np.log(3))


# Choice -----------------------------------------------------------------------------------------


def squares(prediction, target):
    return ((prediction - target) ** 2).mean()


@pytest.mark.parametrize(
    "loss",
    [
        "MSELoss",
        "torch.nn:MSELoss",
        "torch.nn.modules.loss:MSELoss",
        torch.nn.MSELoss,
        torch.nn.MSELoss(),
        "torch.nn.functional:mse_loss",
        torch.nn.functional.mse_loss,
        squares,
    ],
)
def test_loss_in_every_form(loss):
    optimization = optimization_of(FC([2, 1]))
    optimization.set_loss(loss)
    prediction, target = torch.rand(4, 1), torch.rand(4, 1)
    value = optimization.compute_loss(
        batch_of({"prediction": prediction}, {"ground_truth": target})
    )
    torch.testing.assert_close(value, squares(prediction, target))


@pytest.mark.parametrize(
    ("loss", "told"),
    [
        ("MSELos", 'Did you mean "MSELoss"'),
        ("Linear", "It has: .*MSELoss"),
        ("torch.nn:MSELos", 'Did you mean "MSELoss"'),
        (None, "needs a loss"),
        (5, "cannot be called"),
        (torch.nn.Linear, "rejects its arguments"),
    ],
)
def test_wrong_loss(loss, told):
    with pytest.raises(ConfigError, match=told):
        TorchOptimization().set_loss(loss)


def test_arguments_of_the_loss():
    optimization = optimization_of(FC([2, 1]), loss_kwargs={"reduction": "sum"})
    value = optimization.compute_loss(
        batch_of({"prediction": torch.ones(4, 1)}, {"ground_truth": torch.zeros(4, 1)})
    )
    assert value.item() == 4
    with pytest.raises(ConfigError, match="reduction"):
        TorchOptimization(loss_kwargs={"reductoin": "sum"}).set_loss("MSELoss")
    with pytest.raises(ConfigError, match="loss_kwargs"):
        TorchOptimization(loss_kwargs={"reduction": "sum"}).set_loss(squares)


@pytest.mark.parametrize("first", ["loss", "optimizer"])
def test_tensors_of_the_loss_follow_the_network(first):
    class Weighted(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("weight", torch.tensor([2.0]))

        def forward(self, prediction, target):
            return (self.weight * (prediction - target)).mean()

    network = FC([2, 1])
    network.set_data_type("float64")
    optimization = TorchOptimization()
    if first == "loss":
        optimization.set_loss(Weighted)
    optimization.set_optimizer("Adam", network)
    if first == "optimizer":
        optimization.set_loss(Weighted)
    assert optimization.loss.weight.dtype == torch.float64
