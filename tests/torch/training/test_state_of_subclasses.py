"""State that users add to an optimization or its loss: found, trained, saved and restored."""

from __future__ import annotations

import collections
import copy
import dataclasses
import itertools
import random
from functools import partial

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.errors import CheckpointError, ConfigError
from physx_torch import FC, TorchNetwork, TorchOptimization
from physx_torch.storage.state import read_state, write_state


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.random.default_rng(0).standard_normal((60, 3))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x[:40], "y": x[:40, :1] * x[:40, 1:2]})
        dataset.append("validation", {"x": x[40:], "y": x[40:, :1] * x[40:, 1:2]})


NAMES = {option.name for option in dataclasses.fields(NetworkConfig)}
FIELDS = {"net_fields": "x", "opt_fields": "y"}


def train(epoch_nb=4, *, name="run", kind=Training, **options):
    network = {
        "network": "torch/fc",
        "network_kwargs": {"layers": [3, 4, 1], **FIELDS},
        "loss": "MSELoss",
        "optimizer": "Adam",
        "lr": 0.01,
        "device": "cpu",
        **{key: options.pop(key) for key in [*options] if key in NAMES},
    }
    training = kind(
        NetworkConfig(**network), DatasetConfig(existing_dir="data"), epoch_nb=epoch_nb,
        batch_size=10, seed=0, session_name=name, quiet=True, **options,
    )  # fmt: skip
    training.execute()
    return training


def check_resumes(**options):
    """Check that a resumed training ends with the parameters of an uninterrupted one."""
    whole = train(name="whole", **options)
    train(2, **options)
    resumed = train(resume=True, **options)
    for own, other in zip(
        resumed.learner.network.parameters(), whole.learner.network.parameters(), strict=True
    ):
        assert torch.equal(own, other)
    return resumed.learner.optimization, whole.learner.optimization


class Gan(TorchNetwork):
    """A generator and its critic."""

    def __init__(self, **fields):
        super().__init__(**fields)
        self.generator, self.critic = torch.nn.Linear(3, 1), torch.nn.Linear(1, 1)

    def forward(self, x):
        return self.generator(x)


class GanOptimization(TorchOptimization):
    """Two optimizers of parts of the network, in a dictionary, and results of each batch."""

    def set_optimizer(self, optimizer, network, **kwargs):
        super().set_optimizer(optimizer, network, **kwargs)
        parts = {"generator": network.generator, "critic": network.critic}
        self.each = {k: torch.optim.Adam(part.parameters(), **kwargs) for k, part in parts.items()}

    def compute_loss(self, batch):
        critic, fake = self.network.critic, batch.prediction["y"]
        self.critic_loss = (critic(batch.targets["y"]) - 1).square().mean()
        self.critic_loss = self.critic_loss + critic(fake.detach()).square().mean()
        return (critic(fake) - 1).square().mean()

    def optimize(self, loss):
        for name, each in (("generator", loss), ("critic", self.critic_loss)):
            self.each[name].zero_grad()
            each.backward()
            self.each[name].step()


@pytest.mark.reported(
    "pytorch-lightning#2737",
    "pytorch-lightning#17801",
    about="two optimizers, as for adversarial networks, and resuming with them",
)
def test_several_optimizers_resume_bit_for_bit():
    check_resumes(network=Gan, network_kwargs=FIELDS, optimization=GanOptimization)


class Averaging(TorchOptimization):
    """Averages parameters in a dictionary that the first step makes, and in a module."""

    shadow = None

    def set_optimizer(self, optimizer, network, **kwargs):
        super().set_optimizer(optimizer, network, **kwargs)
        self.averaged = torch.optim.swa_utils.AveragedModel(network)

    def optimize(self, loss):
        super().optimize(loss)
        own = self.network.get_parameters()
        if self.shadow is None:
            self.shadow = {name: value.detach().clone() for name, value in own.items()}
        for name, value in own.items():
            self.shadow[name].lerp_(value.detach(), 0.1)
        self.averaged.update_parameters(self.network)


def test_averaged_weights_resume_bit_for_bit():
    resumed, whole = check_resumes(optimization=Averaging)
    assert resumed.shadow.keys() == whole.shadow.keys()
    for name, value in whole.shadow.items():
        assert torch.equal(resumed.shadow[name], value)
    assert resumed.averaged.n_averaged == 16
    for own, other in zip(resumed.averaged.parameters(), whole.averaged.parameters(), strict=True):
        assert torch.equal(own, other)


class Kinds(TorchOptimization):
    """State of every kind, of which the loss depends on some."""

    def __init__(self, decay=0.9):
        super().__init__()
        self.decay, self.steps = decay, 0
        self.names, self.pair = ["a"], (torch.zeros(2), "constant")
        self.recent = collections.deque(maxlen=3)
        self.numbers = np.zeros(3, np.float32)
        self.drawn = [np.random.default_rng(0), random.Random(0), torch.Generator()]
        self.call = partial(max, 0)
        self.text = collections.Counter()

    def compute_loss(self, batch):
        self.error = batch.prediction["y"] - batch.targets["y"]
        first, second, third = self.drawn
        noise = first.random() + second.random() + torch.rand(1, generator=third)
        self.steps += 1
        self.recent.append(float(noise))
        self.numbers[self.steps % 3] += 1
        self.pair[0].add_(1)
        self.text[f"step {self.steps % 2}"] += 1
        scale = 1 + sum(self.recent) * self.steps + self.numbers.sum() + self.pair[0].sum()
        return super().compute_loss(batch) * float(scale)


def test_state_of_every_kind_resumes_bit_for_bit():
    resumed, whole = check_resumes(optimization=Kinds, optimizer="SGD", lr=1e-5)
    assert resumed.steps == whole.steps == 24  # 16 batches, and 4 validations of 2
    assert (resumed.recent, resumed.text) == (whole.recent, whole.text)
    assert resumed.recent.maxlen == 3
    assert resumed.pair[0].tolist() == [24, 24]


def test_other_options_of_the_constructor_are_refused_when_resuming():
    train(2, optimization=Kinds, optimization_kwargs={"decay": 0.9})
    with pytest.raises(ConfigError, match=r"optimization_kwargs was .*0\.9.* and is now .*0\.5"):
        train(4, optimization=Kinds, optimization_kwargs={"decay": 0.5}, resume=True)


# The loss --------------------------------------------------------------------------------------


class Weighted(torch.nn.Module):
    """Weights that the training sets at its beginning: a buffer and a plain number."""

    def __init__(self):
        super().__init__()
        self.register_buffer("first", torch.tensor(0.5))
        self.second = 0.5
        self.norms = []

    def forward(self, prediction, target):
        error = prediction - target
        return self.first * error.square().mean() + self.second * error.abs().mean()


class Balanced(Training):
    """Balances the parts of the loss by what the network predicts when the training begins."""

    def train_begin(self):
        super().train_begin()
        batch = next(iter(self.data.dataset.batches("training", 40, dtype="float32")))
        prediction, _ = self.learner.compare(batch, 40)
        scale, loss = float(np.abs(prediction["y"]).mean()), self.learner.optimization.loss
        loss.first.fill_(scale / (1 + scale))
        loss.second = 1 / (1 + scale)
        torch.rand(3)


def test_weights_of_the_loss_resume_bit_for_bit():
    resumed, whole = check_resumes(loss=Weighted, kind=Balanced)
    assert resumed.loss.first == whole.loss.first != 0.5
    assert resumed.loss.second == whole.loss.second != 0.5


class Learned(torch.nn.Module):
    """A loss with a learned weight."""

    def __init__(self):
        super().__init__()
        self.log_variance = torch.nn.Parameter(torch.zeros(()))

    def forward(self, prediction, target):
        return (prediction - target).square().mean() / self.log_variance.exp() + self.log_variance


@pytest.mark.parametrize("options", [{}, {"accumulate": 3, "gradient_clip": 1.0}])
@pytest.mark.parametrize("optimizer", ["Adam", torch.optim.SGD])
def test_parameters_of_the_loss_are_trained_and_resume_bit_for_bit(optimizer, options):
    resumed, whole = check_resumes(loss=Learned, optimizer=optimizer, optimization_kwargs=options)
    assert resumed.loss.log_variance == whole.loss.log_variance != 0


def test_the_first_lines_say_that_the_loss_is_trained(capsys):
    training = Training(
        NetworkConfig(
            "torch/fc", {"layers": [3, 1], **FIELDS}, loss=Learned, optimizer="SGD", lr=0.1
        ),
        DatasetConfig(existing_dir="data"), epoch_nb=1, batch_size=10,
    )  # fmt: skip
    training.execute()
    assert "loss: 1 parameters, trained with the network's\n" in capsys.readouterr().err


def test_a_loss_set_after_the_optimizer_is_trained_too():
    network, optimization = FC([2, 1]), TorchOptimization()
    optimization.set_optimizer("SGD", network, lr=0.1)
    optimization.set_loss(Learned)
    loss = optimization.loss(network(torch.ones(4, 2)), torch.ones(4, 1))
    optimization.optimize(loss)
    assert optimization.loss.log_variance != 0


# What cannot be saved --------------------------------------------------------------------------


class Average:
    """An object with tensors, which cannot save itself."""

    def __init__(self, network):
        self.values = [value.detach().clone() for value in network.parameters()]


class Counter:
    """An object that changes."""

    count = 0


class Refused(TorchOptimization):
    """Adds what `make` returns as the attribute "extra", and changes it in each step."""

    make = staticmethod(Average)
    change = staticmethod(lambda extra: extra)

    def set_optimizer(self, optimizer, network, **kwargs):
        super().set_optimizer(optimizer, network, **kwargs)
        self.extra = self.make(network)

    def optimize(self, loss):
        super().optimize(loss)
        self.extra = self.change(self.extra)


def counted(extra):
    extra.count += 1
    return extra


def closing_over(network):
    average = Average(network)
    return lambda: average


def summing(network):
    total = torch.zeros(1)
    return lambda: total.data.add_(1)


def called(extra):
    extra()
    return extra


def averaged(extra):
    return extra or torch.optim.swa_utils.AveragedModel(torch.nn.Linear(1, 1))


REFUSED = {
    "object with tensors": (Average, None, "contains a Tensor"),
    "list of them": (lambda network: [torch.zeros(1), Average(network)], None, "contains a Tensor"),
    "function with state": (closing_over, None, "contains a Tensor"),
    "iterator": (lambda network: itertools.count(), None, "has a position"),
    "object that changes": (lambda network: Counter(), counted, "Counter that changes"),
    "function that changes": (summing, called, "function that changes"),
    "module made later": (lambda network: None, averaged, "create it in set_optimizer"),
    "key that is no text": (lambda network: {(1, 2): 3}, None, "key that is a tuple"),
}


@pytest.mark.parametrize(("make", "change", "reason"), REFUSED.values(), ids=REFUSED)
def test_state_that_cannot_be_saved_is_refused_at_the_beginning(make, change, reason):
    own = {"make": staticmethod(make)} | ({"change": staticmethod(change)} if change else {})
    kind = type("Own", (Refused,), own)
    with pytest.raises(CheckpointError, match=reason) as caught:
        train(optimization=kind)
    assert '"extra' in str(caught.value)
    assert 'unsaved = ("extra' in str(caught.value)
    training = train(optimization=type("Declared", (kind,), {"unsaved": ("extra",)}), name="other")
    assert training.epoch_id == 4

    def save_state(self, path):
        TorchOptimization.save_state(self, path)

    train(optimization=type("Saving", (kind,), {"save_state": save_state}), name="third")


class Late(Refused):
    """Its object changes in the third epoch."""

    make = staticmethod(lambda network: Counter())

    def epoch_end(self, loss):
        super().epoch_end(loss)
        self.extra.epochs = getattr(self.extra, "epochs", 0) + 1


def test_state_that_changes_later_is_refused_when_resuming():
    train(2, optimization=Late)
    with pytest.raises(CheckpointError, match=r'"extra" is a Counter that changes.*network_dir'):
        train(optimization=Late, resume=True)


def test_state_that_an_earlier_version_did_not_save_is_named():
    training = train(2, optimization=Averaging)
    file = training.checkpoint_path / "optimization.safetensors"
    state = read_state(file)
    del state["attributes"]
    write_state(file, state)
    with pytest.raises(CheckpointError, match="lacks the state of averaged"):
        training.learner.optimization.load_state(file)
    plain = train(2, name="plain")
    file = plain.checkpoint_path / "optimization.safetensors"
    state = read_state(file)
    del state["attributes"]
    write_state(file, state)
    plain.learner.optimization.load_state(file)


def test_a_checkpoint_cannot_replace_methods():
    training = train(2)
    file = training.checkpoint_path / "optimization.safetensors"
    state = read_state(file)
    for name in ("optimize", "_network"):
        write_state(file, {**state, "attributes": {name: {"plain": 1}}})
        with pytest.raises(CheckpointError, match="not an attribute that may be replaced"):
            training.learner.optimization.load_state(file)


def test_tensors_of_equal_paths_are_stored_separately(tmp_path):
    state = {"a/b": torch.zeros(1), "a": {"b": torch.ones(2)}}
    write_state(tmp_path / "state", copy.deepcopy(state))
    read = read_state(tmp_path / "state")
    assert read["a/b"].tolist() == [0]
    assert read["a"]["b"].tolist() == [1, 1]
