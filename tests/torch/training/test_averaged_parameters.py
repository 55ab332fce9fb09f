"""The mean of the parameters over the steps of a training, with which a network predicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from physx_core import Dataset, NetworkConfig, Training
from physx_core.errors import ConfigError
from physx_core.pipelines import load_learner
from physx_torch.storage.parameters import read_tensors

DECAY = 0.8


class Normed(torch.nn.Module):
    """Has running statistics and a mask with infinity."""

    def __init__(self):
        super().__init__()
        self.first, self.last = torch.nn.Linear(3, 8), torch.nn.Linear(8, 1)
        self.norm = torch.nn.BatchNorm1d(8)
        self.register_buffer("mask", torch.tensor([0.0, float("inf")]))

    def forward(self, x):
        return self.last(torch.tanh(self.norm(self.first(x))))


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        for mode in ("training", "validation"):
            x = rng.standard_normal((60, 3))
            dataset.append(mode, {"x": x, "y": x[:, :1] * x[:, 1:2]})


class Watched(Training):
    """Keeps the network's state after each batch, and may stop by an error."""

    stops_after = None

    def train_begin(self):
        self.states = []

    def batch_end(self):
        state = self.learner.network.state_dict()
        self.states.append({name: value.clone() for name, value in state.items()})
        if self.stops_after == self.epoch_id * 6 + self.batch_id:
            raise RuntimeError("stopped here")


def training(average=DECAY, kind=Watched, **options):
    config = NetworkConfig(
        Normed, {"net_fields": "x", "opt_fields": "y"}, loss="MSELoss", optimizer="Adam", lr=1e-2,
        device="cpu", optimization_kwargs={"average": average, "accumulate": 2},
    )  # fmt: skip
    given = {"epoch_nb": 2, "batch_size": 10, "seed": 0, "quiet": True, "rivals": "none"}
    return kind(config, "data", **{**given, **options})


def mean_of(states):
    """Return the exponential mean over the steps, one of every two batches."""
    mean = None
    for step, state in enumerate(states[1::2]):
        mean = mean or state
        share = min(DECAY, (1 + step) / (10 + step))
        mean = {name: share * mean[name] + (1 - share) * state[name] for name in state}
    return mean


def test_a_network_learns_as_without_a_mean_and_predicts_with_it():
    plain = training(average=None, session_name="plain")
    plain.execute()
    averaged = training(session_name="averaged")
    averaged.execute()
    for own, other in zip(averaged.states, plain.states, strict=True):
        assert all(torch.equal(own[name], other[name]) for name in own)
    expected = mean_of(averaged.states)
    stored, _ = read_tensors(averaged.checkpoint_path / "parameters.safetensors")
    for name, values in stored.items():
        if "num_batches" not in name:
            torch.testing.assert_close(values, expected[name])
    module = Normed()
    module.load_state_dict({name.removeprefix("module."): v for name, v in stored.items()})
    module.eval()
    with Dataset.open("data") as dataset, torch.no_grad():
        rows = {name: dataset["validation"][name][:] for name in ("x", "y")}
        x = torch.from_numpy(rows["x"]).float()
        loss = (module(x) - torch.from_numpy(rows["y"]).float()).square().mean().item()
        answer = load_learner("sessions/averaged", NetworkConfig(Normed)).predict(rows)["y"]
        np.testing.assert_allclose(answer, module(x).numpy(), atol=1e-6)
    assert averaged.validation_loss == pytest.approx(loss, rel=1e-5)
    assert averaged.validation_loss != plain.validation_loss


@pytest.mark.parametrize("after", [3, 4, 8])
@pytest.mark.reported(
    "pytorch-lightning#10914",
    "pytorch-lightning#20545",
    "neural-lam#336",
    about="averaged weights in validation and checkpoints",
)
def test_a_training_with_a_mean_that_was_stopped_goes_on_bit_for_bit(after):
    whole = training(session_name="whole")
    whole.execute()
    first = training(session_name="halves")
    first.stops_after = after
    with pytest.raises(RuntimeError, match="stopped here"):
        first.execute()
    second = training(session_name="halves", resume=True)
    second.execute()
    for own, other in zip(second.states, whole.states[after:], strict=True):
        assert all(torch.equal(own[name], other[name]) for name in own)
    files = [each.checkpoint_path / "parameters.safetensors" for each in (whole, second)]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert second.validation_loss == whole.validation_loss


def test_another_training_starts_from_the_mean():
    training(session_name="first").execute()
    config = training().network_config
    another = training(session_name="second", epoch_nb=1)
    another.network_config = NetworkConfig(
        **{**vars(config), "network_dir": "sessions/first", "lr": 0.0}
    )
    another.execute()
    stored, _ = read_tensors(Path("sessions/first/network/network_0/parameters.safetensors"))
    assert torch.equal(another.states[0]["module.last.weight"], stored["module.last.weight"])


@pytest.mark.parametrize("share", [0.0, 1.0, 2.0, -0.5])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(ConfigError, match="average is .* between 0 and 1"):
        training(average=share).execute()
