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


# Terms ------------------------------------------------------------------------------------------


def two_fields():
    network = FC([2, 4], opt_fields=["u", "p"])
    prediction = {"u": torch.zeros(5, 3), "p": torch.zeros(5, 1)}
    targets = {"u": torch.full((5, 3), 2.0), "p": torch.full((5, 1), 4.0)}
    return network, batch_of(prediction, targets)


def total(batch):
    return sum((batch.targets[name] - batch.prediction[name]).mean() for name in batch.targets)


@pytest.mark.parametrize(
    ("loss", "weights", "expected", "terms"),
    [
        ({"u": "MSELoss", "p": "L1Loss"}, None, (4 + 4) / 2, {"u": 4, "p": 4}),
        ("L1Loss", {"u": 1.0, "p": 0.25}, (2 + 0.25 * 4) / 1.25, {"u": 2, "p": 4}),
        ("L1Loss", {"p": 3}, (2 + 3 * 4) / 4, {"u": 2, "p": 4}),
        ({"u": "L1Loss", "both": total}, {"both": 0.5}, (2 + 0.5 * 6) / 1.5, {"u": 2, "both": 6}),
        ({"both": total}, None, 6, {"both": 6}),
        (total, None, 6, {}),
    ],
)
def test_the_loss_is_the_weighted_mean_of_its_terms(loss, weights, expected, terms):
    network, batch = two_fields()
    optimization = optimization_of(network, loss, loss_weights=weights)
    value = optimization.compute_loss(batch)
    assert value.item() == pytest.approx(expected)
    found = optimization.transform_loss(value, batch)
    known = {"loss": expected, **{f"loss/{name}": each for name, each in terms.items()}}
    assert {name: float(each) for name, each in found.items()} == pytest.approx(known)


def test_each_loss_of_a_table_has_its_own_arguments_and_learns():
    class Scaled(torch.nn.Module):
        def __init__(self, power=1):
            super().__init__()
            self.power, self.scale = power, torch.nn.Parameter(torch.ones(()))

        def forward(self, prediction, target):
            return self.scale * (prediction - target).abs().pow(self.power).mean()

    network, batch = two_fields()
    table = {"u": Scaled, "p": "HuberLoss"}
    arguments = {"u": {"power": 3}, "p": {"delta": 2.0}}
    optimization = optimization_of(network, table, loss_kwargs=arguments)
    assert optimization.compute_loss(batch).item() == (8 + 2 * (4 - 1)) / 2
    learned = optimization.optimizer.param_groups[0]["params"]
    assert any(each is optimization.loss.losses["u"].scale for each in learned)


@pytest.mark.parametrize(
    ("loss", "options", "told"),
    [
        ({"u": "MSELoss"}, {}, "has none for p"),
        ({"u": "MSELoss", "q": "MSELoss"}, {}, '"q" compares .* its targets are p, u'),
        ({"u": "MSELos", "p": "MSELoss"}, {}, 'Did you mean "MSELoss"'),
        ({}, {}, "is empty"),
        ("MSELoss", {"loss_weights": {"u": 1.0, "v": 1.0}}, "loss_weights names v"),
        (total, {"loss_weights": {"u": 1.0}}, "a single one without a name"),
        ("MSELoss", {"loss_weights": {"u": -1.0}}, "not negative"),
        ("MSELoss", {"loss_weights": {"u": 0.0}}, "not all 0"),
        ("MSELoss", {"loss_weights": 2.0}, "numbers by name"),
        ({"u": "MSELoss", "p": "MSELoss"}, {"loss_kwargs": {"v": {}}}, "loss_kwargs names v"),
    ],
)
def test_wrong_terms(loss, options, told):
    with pytest.raises(ConfigError, match=told):
        optimization_of(two_fields()[0], loss, **options)
