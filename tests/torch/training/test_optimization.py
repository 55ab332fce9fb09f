"""How a network learns, with optimizers and schedulers, and how its training is resumed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Field, Normalization, Transformation
from physx_core.components import PredictedBatch
from physx_core.errors import CheckpointError, ConfigError, UsageError
from physx_torch import FC, TorchNetwork, TorchOptimization, TorchTransformation

SHAPES = {"input": Field("input", (2,)), "ground_truth": Field("ground_truth", (1,))}


def made(layers=(2, 8, 1), optimizer="Adam", options=None, scheduler=None, **kwargs):
    network = FC(list(layers))
    network.bind(SHAPES)
    network.set_train()
    optimization = TorchOptimization(**(options or {}))
    optimization.set_loss("MSELoss")
    optimization.set_optimizer(optimizer, network, **kwargs)
    if scheduler is not None:
        name, arguments = scheduler
        optimization.set_scheduler(name, **arguments)
    return network, optimization


def regression(number=128):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (number, 2))
    return {"input": x, "ground_truth": 50 + 10 * (x[:, :1] ** 3 - x[:, 1:])}


def learn(network, optimization, tensors, steps):
    losses = []
    for _ in range(steps):
        batch = PredictedBatch.of(network, Transformation(), tensors)
        loss = optimization.compute_loss(batch)
        optimization.optimize(loss)
        losses.append(optimization.transform_loss(loss, batch)["loss"])
    return losses


def rate(optimization):
    return optimization.optimizer.param_groups[0]["lr"]


# Learning ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_normalized_regression_is_learned():
    network, optimization = made([2, 16, 16, 1], lr=1e-2)
    batch = regression()
    transformation = TorchTransformation()
    normalization = {
        name: Normalization(values.mean(axis=0), values.std(axis=0))
        for name, values in batch.items()
    }
    transformation.set_normalization(normalization, network)
    data = network.numpy_to_tensor(batch)
    losses = []
    for _ in range(300):
        predicted = PredictedBatch.of(network, transformation, data)
        loss = optimization.compute_loss(predicted)
        optimization.optimize(loss)
        losses.append(optimization.transform_loss(loss, predicted))
    assert losses[0]["loss"] > 0.5
    assert losses[-1]["loss"] < 1e-3
    assert all(isinstance(item["loss"], float) for item in losses)
    network.set_eval()
    prediction = network.predict(transformation.transform_before_prediction(data))
    physical = network.tensor_to_numpy(transformation.transform_before_apply(prediction))
    error = np.abs(physical["prediction"] - batch["ground_truth"])
    assert error.mean() < 0.25  # of values between 30 and 70


def test_one_step_of_gradient_descent_by_hand():
    network, optimization = made([2, 1], "SGD", lr=0.1)
    weight = network.layers[0].weight.detach().clone()
    tensors = {"input": torch.tensor([[1.0, 2.0]]), "ground_truth": torch.tensor([[0.0]])}
    prediction = network.predict(tensors)["prediction"].item()
    learn(network, optimization, tensors, 1)
    expected = weight - 0.1 * 2 * prediction * tensors["input"]
    torch.testing.assert_close(network.layers[0].weight.detach(), expected)


class Doubled(TorchOptimization):
    """Has a loss of its own."""

    def compute_loss(self, batch):
        return 2 * super().compute_loss(batch)


@pytest.mark.parametrize(
    ("kind", "loss"),
    [
        (TorchOptimization, "MSELoss"),
        (TorchOptimization, "SmoothL1Loss"),
        (TorchOptimization, lambda a, b: ((a - b) ** 4).mean()),
        (Doubled, "L1Loss"),
    ],
)
def test_the_losses_of_rows_are_those_of_batches_of_one_row(kind, loss):
    network, _ = made()
    optimization = kind()
    optimization.set_loss(loss)
    optimization.set_optimizer("SGD", network, lr=0.1)
    tensors = network.numpy_to_tensor(regression(7))
    batch = PredictedBatch.of(network, Transformation(), tensors)
    losses = optimization.compute_row_losses(batch)
    assert losses.shape == (7,)
    assert not losses.requires_grad
    for row in range(7):
        one = {name: value[row : row + 1] for name, value in tensors.items()}
        alone = optimization.compute_loss(PredictedBatch.of(network, Transformation(), one))
        assert losses[row].item() == pytest.approx(alone.item(), rel=1e-5)
    whole = optimization.compute_loss(batch)
    assert losses.mean().item() == pytest.approx(whole.item(), rel=1e-5)


def test_only_the_network_needs_gradients():
    network, optimization = made()
    data = network.numpy_to_tensor(regression(4))
    learn(network, optimization, data, 1)
    assert not any(tensor.requires_grad for tensor in data.values())


def test_gradients_are_clipped_together():
    network, optimization = made([2, 1], "SGD", {"gradient_clip": 0.5}, lr=1.0)
    before = torch.cat([p.detach().flatten().clone() for p in network.parameters()])
    tensors = {"input": torch.full((1, 2), 100.0), "ground_truth": torch.full((1, 1), -1000.0)}
    learn(network, optimization, tensors, 1)
    after = torch.cat([p.detach().flatten() for p in network.parameters()])
    assert torch.linalg.vector_norm(after - before).item() == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("clip", [0, -1.0])
def test_wrong_gradient_clip(clip):
    with pytest.raises(ConfigError, match="gradient_clip"):
        TorchOptimization(gradient_clip=clip)


# Optimizer --------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["SGD", "torch.optim:SGD", torch.optim.SGD])
def test_optimizer_in_every_form(optimizer):
    _, optimization = made(optimizer=optimizer, lr=0.25, momentum=0.5)
    group = optimization.optimizer.param_groups[0]
    assert isinstance(optimization.optimizer, torch.optim.SGD)
    assert (group["lr"], group["momentum"]) == (0.25, 0.5)


@pytest.mark.parametrize("name", ["Adam", "AdamW", "SGD", "RMSprop", "NAdam", "Adagrad"])
def test_common_optimizers_learn(name):
    network, optimization = made(optimizer=name)
    losses = learn(network, optimization, network.numpy_to_tensor(regression(16)), 20)
    assert losses[-1] < losses[0]


@pytest.mark.parametrize(
    ("optimizer", "arguments", "told"),
    [
        ("adam", {}, 'Did you mean "Adam"'),
        (None, {}, "needs an optimizer"),
        ("Adam", {"learning_rate": 1e-3}, "It takes: params, lr"),
        ("Adam", {"lr": -1.0}, "Invalid learning rate"),
        ("LBFGS", {}, "several times"),
        ("lr_scheduler", {}, "no optimizer"),
        (list, {}, "list is a class, but not a torch.optim.Optimizer"),
    ],
)
def test_wrong_optimizer(optimizer, arguments, told):
    with pytest.raises(ConfigError, match=told):
        TorchOptimization().set_optimizer(optimizer, FC([2, 1]), **arguments)


def test_network_without_parameters():
    class Nothing(TorchNetwork):
        pass

    with pytest.raises(ConfigError, match="empty parameter list"):
        TorchOptimization().set_optimizer("Adam", Nothing())


def test_network_of_another_library():
    with pytest.raises(ConfigError, match="not a TorchNetwork"):
        TorchOptimization().set_optimizer("Adam", object())


def test_frozen_parameters_stay():
    network = FC([2, 4, 1])
    network.layers[0].weight.requires_grad_(False)
    frozen = network.layers[0].weight.clone()
    optimization = TorchOptimization()
    optimization.set_loss("MSELoss")
    optimization.set_optimizer("Adam", network)
    learn(network, optimization, network.numpy_to_tensor(regression(4)), 2)
    assert torch.equal(network.layers[0].weight, frozen)


def test_calls_out_of_order(tmp_path):
    optimization = TorchOptimization()
    with pytest.raises(UsageError, match="set_loss"):
        optimization.compute_loss(None)
    with pytest.raises(UsageError, match="set_optimizer"):
        optimization.optimize(torch.tensor(1.0))
    with pytest.raises(UsageError, match="set_optimizer"):
        optimization.set_scheduler("StepLR", step_size=1)
    with pytest.raises(UsageError, match="set_optimizer"):
        optimization.save_state(tmp_path / "s")
    with pytest.raises(UsageError, match="set_optimizer"):
        optimization.load_state(tmp_path / "s")


# Scheduler --------------------------------------------------------------------------------------


def test_scheduler_changes_the_rate_after_each_epoch():
    network, optimization = made(scheduler=("CosineAnnealingLR", {"T_max": 10}), lr=1.0)
    data = network.numpy_to_tensor(regression(4))
    rates = []
    for _ in range(10):
        learn(network, optimization, data, 2)
        rates.append(optimization.learning_rate())
        optimization.schedule(1.0)
    expected = [(1 + np.cos(np.pi * epoch / 10)) / 2 for epoch in range(10)]
    np.testing.assert_allclose(rates, expected, atol=1e-12)


def test_no_scheduler_keeps_the_rate():
    _, optimization = made(lr=0.125)
    optimization.schedule(1.0)
    assert rate(optimization) == 0.125
    assert TorchOptimization().learning_rate() is None


def test_plateau_looks_at_the_loss_of_the_epoch():
    plateau = ("ReduceLROnPlateau", {"patience": 0, "factor": 0.5})
    _, optimization = made(scheduler=plateau, lr=1.0)
    rates = []
    for loss in (3.0, 2.0, 2.5, 1.0, 1.0):
        optimization.schedule(loss)
        rates.append(rate(optimization))
    assert rates == [1.0, 1.0, 0.5, 0.5, 0.25]


@pytest.mark.parametrize(
    ("scheduler", "told"),
    [
        (("CosinAnnealingLR", {}), 'Did you mean "CosineAnnealingLR"'),
        (("CosineAnnealingLR", {}), "T_max"),
        (("StepLR", {"steps": 3}), "step_size"),
        ((dict, {}), "dict is a class, but not a torch.optim.LRScheduler"),
        ((id, {}), "not a scheduler"),
    ],
)
def test_wrong_scheduler(scheduler, told):
    with pytest.raises(ConfigError, match=told):
        made(scheduler=scheduler)


# State ------------------------------------------------------------------------------------------

PLANS = {
    "Adam": ("Adam", None, {}),
    "momentum and cosine": ("SGD", ("CosineAnnealingLR", {"T_max": 9}), {}),
    "milestones": ("AdamW", ("MultiStepLR", {"milestones": [1, 3]}), {}),
    "plateau": ("Adam", ("ReduceLROnPlateau", {"patience": 0}), {}),
    "accumulated and clipped": (
        "Adam",
        ("StepLR", {"step_size": 2}),
        {"accumulate": 2, "gradient_clip": 0.1},
    ),
    "bfloat16": ("Adam", None, {"mixed_precision": "bfloat16"}),
    "float16": ("Adam", None, {"mixed_precision": "float16", "gradient_clip": 1.0}),
}


class Forgetful(FC):
    """Draws random numbers while it learns."""

    def forward(self, x):
        return super().forward(torch.nn.functional.dropout(x, 0.5, self.training))


@pytest.mark.parametrize("plan", PLANS)
def test_a_resumed_training_is_the_uninterrupted_one(tmp_path, plan):
    optimizer, scheduler, options = PLANS[plan]
    arguments = {"lr": 1e-4, "momentum": 0.9} if optimizer == "SGD" else {"lr": 1e-2}

    def start():
        network = Forgetful([2, 4, 1])
        optimization = TorchOptimization(**options)
        optimization.set_loss("MSELoss")
        optimization.set_optimizer(optimizer, network, **arguments)
        if scheduler is not None:
            optimization.set_scheduler(scheduler[0], **scheduler[1])
        return network, optimization

    def epochs(network, optimization, number):
        data = network.numpy_to_tensor(regression(8))
        for _ in range(number):
            losses = learn(network, optimization, data, 3)
            optimization.schedule(losses[-1])

    first, optimization = start()
    epochs(first, optimization, 3)
    first.save_parameters(tmp_path / "p")
    optimization.save_state(tmp_path / TorchOptimization.state_file)
    epochs(first, optimization, 2)

    second, resumed = start()
    second.load_parameters(tmp_path / "p")
    resumed.load_state(tmp_path / TorchOptimization.state_file)
    epochs(second, resumed, 2)
    assert rate(resumed) == rate(optimization)
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)


def test_state_of_another_optimizer_or_network(tmp_path):
    network, optimization = made()
    learn(network, optimization, network.numpy_to_tensor(regression(4)), 1)
    optimization.save_state(tmp_path / "s")
    with pytest.raises(CheckpointError, match="of Adam, not of SGD and StepLR"):
        made(optimizer="SGD", scheduler=("StepLR", {"step_size": 1}))[1].load_state(tmp_path / "s")
    with pytest.raises(CheckpointError, match="another network"):
        made([2, 8, 8, 1])[1].load_state(tmp_path / "s")
    network.save_parameters(tmp_path / "p")
    with pytest.raises(CheckpointError, match="not contain the state"):
        optimization.load_state(tmp_path / "p")
    with pytest.raises(CheckpointError, match="no file"):
        optimization.load_state(tmp_path / "nothing")


def test_state_that_would_need_code(tmp_path):
    _, optimization = made()
    optimization.set_scheduler(torch.optim.lr_scheduler.LambdaLR, lr_lambda=lambda epoch: 0.5)
    optimization.scheduler.odd = object()
    with pytest.raises(CheckpointError, match="odd.*object"):
        optimization.save_state(tmp_path / "s")
