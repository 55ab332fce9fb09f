"""Learning-rate schedules: when they are stepped, what is said of it, and how they resume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.optim.lr_scheduler import (
    CosineAnnealingLR,
    LambdaLR,
    LinearLR,
    OneCycleLR,
    SequentialLR,
)

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.errors import CheckpointError, ConfigError
from physx_torch import TorchOptimization
from physx_torch.storage.state import read_state, write_state


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.random.default_rng(0).standard_normal((60, 3))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x[:40], "y": x[:40, :1]})
        dataset.append("validation", {"x": x[40:], "y": x[40:, :1]})


class Watched(Training):
    """Notes the learning rate of each batch."""

    def optimize(self):
        self.rates = [*getattr(self, "rates", ()), self.learner.learning_rate]
        super().optimize()


def train(scheduler, epoch_nb=3, *, interval=None, name="run", network=None, **options):
    kind, arguments = scheduler
    config = NetworkConfig(
        "torch/fc",
        {"layers": [3, 4, 1], "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="SGD",
        lr=0.01,
        scheduler=kind,
        scheduler_kwargs=arguments,
        scheduler_interval=interval,
        device="cpu",
        **(network or {}),
    )
    training = Watched(
        config, DatasetConfig(existing_dir="data"), epoch_nb=epoch_nb, batch_size=10, seed=0,
        session_name=name, **options,
    )  # fmt: skip
    training.execute()
    return training


def rates_of_torch(make, steps):
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.01)
    scheduler, rates = make(optimizer), []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return rates


def parameters(training):
    return torch.cat([p.detach().flatten() for p in training.learner.network.parameters()])


ONE_CYCLE = ("OneCycleLR", {"max_lr": 0.05, "total_steps": 12})


@pytest.mark.reported(
    "pytorch#65417",
    "pytorch-lightning#3205",
    "pytorch-lightning#20436",
    "pytorch-lightning#6948",
    about="a schedule that counts steps is stepped once an epoch, in silence",
)
def test_a_schedule_that_counts_steps_follows_the_optimizer(capsys):
    training = train(ONE_CYCLE)
    assert training.rates == rates_of_torch(lambda o: OneCycleLR(o, 0.05, total_steps=12), 12)
    assert "learning rate: OneCycleLR, stepped every batch\n" in capsys.readouterr().err


class WarmUp(LambdaLR):
    """A schedule with an argument that is a number of steps by name."""

    def __init__(self, optimizer, num_warmup_steps):
        super().__init__(optimizer, lambda step: min(1.0, (step + 1) / num_warmup_steps))


class WarmCycle(SequentialLR):
    """A composed schedule, one of whose parts counts steps."""

    def __init__(self, optimizer):
        parts = [LinearLR(optimizer, 0.1, 1.0, 2), OneCycleLR(optimizer, 0.05, total_steps=10)]
        super().__init__(optimizer, parts, [2])


@pytest.mark.parametrize(
    ("scheduler", "interval", "said"),
    [
        (("CyclicLR", {"base_lr": 0.01, "max_lr": 0.05}), None, "CyclicLR, stepped every batch"),
        ((WarmUp, {"num_warmup_steps": 5}), None, "WarmUp, stepped every batch"),
        ((WarmCycle, {}), None, "WarmCycle, stepped every batch"),
        (("StepLR", {"step_size": 2}), None, "StepLR, stepped every epoch"),
        (("StepLR", {"step_size": 2}), "step", "StepLR, stepped every batch"),
        (("ReduceLROnPlateau", {}), None, "ReduceLROnPlateau, stepped every epoch"),
        (ONE_CYCLE, "epoch", "OneCycleLR, stepped every epoch: 3 of its 12 steps"),
        (
            ("CosineAnnealingLR", {"T_max": 12}),
            None,
            "CosineAnnealingLR, stepped every epoch: 3 of its 12 steps",
        ),
    ],
)
def test_the_first_lines_say_when_the_scheduler_is_stepped(scheduler, interval, said, capsys):
    train(scheduler, interval=interval)
    assert f"learning rate: {said}\n" in capsys.readouterr().err


def test_any_schedule_can_be_stepped_with_the_optimizer():
    training = train(("CosineAnnealingLR", {"T_max": 12}), interval="step")
    assert training.rates == rates_of_torch(lambda o: CosineAnnealingLR(o, 12), 12)


def test_accumulated_batches_make_one_step_of_the_schedule(capsys):
    training = train(
        ("OneCycleLR", {"max_lr": 0.05, "total_steps": 6}),
        network={"optimization_kwargs": {"accumulate": 2}},
    )
    rates = rates_of_torch(lambda o: OneCycleLR(o, 0.05, total_steps=6), 6)
    assert training.rates == [rate for rate in rates for _ in range(2)]
    assert "OneCycleLR, stepped every 2 batches\n" in capsys.readouterr().err


class OwnStep(TorchOptimization):
    """Replaces the step, as a subclass with several optimizers does."""

    def optimize(self, loss):
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def test_a_replaced_step_still_steps_the_schedule():
    training = train(ONE_CYCLE, network={"optimization": OwnStep})
    assert training.rates == rates_of_torch(lambda o: OneCycleLR(o, 0.05, total_steps=12), 12)


class OwnEpochEnd(TorchOptimization):
    """Overrides the event without the base class's method."""

    def epoch_end(self, loss):
        self.judged = [*getattr(self, "judged", ()), loss]


def test_overriding_epoch_end_keeps_the_schedule():
    plain, own = (
        train(("StepLR", {"step_size": 1}), name=name, network={"optimization": optimization})
        for name, optimization in (("plain", None), ("own", OwnEpochEnd))
    )
    assert own.rates == plain.rates and own.rates[-1] < own.rates[0]
    assert len(own.learner.optimization.judged) == 3


@pytest.mark.parametrize("interval", ["epoch", "step"])
@pytest.mark.reported(
    "pytorch-lightning#15462",
    "pytorch-lightning#850",
    "pytorch-lightning#4655",
    "pytorch-lightning#1772",
    about="the learning rate is another one after resuming",
)
def test_schedules_resume_bit_for_bit(interval):
    scheduler = ("OneCycleLR", {"max_lr": 0.05, "total_steps": 16})
    whole = train(scheduler, 4, interval=interval, name="whole")
    train(scheduler, 2, interval=interval)
    resumed = train(scheduler, 4, interval=interval, resume=True)
    assert torch.equal(parameters(resumed), parameters(whole))
    assert resumed.rates == whole.rates[8:]
    assert resumed.validation_loss == whole.validation_loss


def test_a_schedule_that_ends_before_the_training_is_refused():
    with pytest.raises(ConfigError, match="has 12 steps, but the training takes 16") as caught:
        train(ONE_CYCLE, 4)
    assert "total_steps=16" in str(caught.value)
    train(ONE_CYCLE, 2)
    with pytest.raises(ConfigError, match="has 12 steps, but the training takes 16"):
        train(ONE_CYCLE, 4, resume=True)
    longer = ("OneCycleLR", {"max_lr": 0.05, "total_steps": 16})
    with pytest.raises(ConfigError, match=r"scheduler_kwargs was .*12\} and is now .*16\}"):
        train(longer, 4, resume=True)


def test_a_schedule_longer_than_the_training_is_told(capsys):
    train(("OneCycleLR", {"max_lr": 0.05, "total_steps": 100}))
    assert "stepped every batch: 12 of its 100 steps\n" in capsys.readouterr().err


def test_plateaus_are_of_epochs():
    with pytest.raises(ConfigError, match="compares the losses of epochs"):
        train(("ReduceLROnPlateau", {}), interval="step")


def test_an_interval_needs_a_scheduler():
    with pytest.raises(ConfigError, match="scheduler_interval is given without a scheduler"):
        train((None, {}), interval="step")


def test_a_schedule_that_was_stepped_otherwise_is_not_resumed():
    training = train(ONE_CYCLE, 2, interval="epoch")
    file = training.checkpoint_path / "optimization.safetensors"
    state = read_state(file)
    del state["interval"]  # as versions wrote it that knew epochs only
    write_state(file, state)
    with pytest.raises(CheckpointError, match='set NetworkConfig.scheduler_interval="epoch"'):
        training.learner.optimization.scheduler_interval = "step"
        training.learner.optimization.load_state(file)
